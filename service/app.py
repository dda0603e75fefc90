"""The application: wiring and lifespan, nothing else."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware
from threadpoolctl import threadpool_limits

from service import __version__, problems
from service.dependencies import Service
from service.description import describe
from service.metrics import Metrics
from service.middleware import AnswerHead, LimitBody, Observe, RequireKey
from service.recent import RecentAnswers
from service.reloading import Reloader
from service.repository import ModelRepository
from service.routes import codes, health, inference, interpolations, models, operation, page, shapes
from service.settings import Settings
from service.workers import Workers

#: What pages of other origins may send, and see in answers.
CORS_REQUEST = ["Authorization", "Content-Type", "If-None-Match", "Inference-Header-Content-Length"]
CORS_REQUEST += ["X-API-Key", "X-Request-ID"]
CORS_ANSWER = ["Content-Disposition", "ETag", "Inference-Header-Content-Length", "Location", "Retry-After"]
CORS_ANSWER += ["Server-Timing", "Shape-Color", "Shape-Diagnostics", "X-Request-ID"]


def create_app(settings: Settings | None = None) -> FastAPI:
    """The service as an ASGI application; bundles are loaded when it starts.

    Args:
        settings: by default from the environment.
    """
    settings = settings or Settings()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        # The workers are the only threads: those of BLAS would multiply with them.
        with threadpool_limits(1):
            workers = Workers(settings.workers, settings.queue, settings.deadline)
            repository = ModelRepository(settings.models_dir, settings.workers)
            metrics = Metrics(repository, workers)
            reloader = Reloader(repository, metrics)
            app.state.service = Service(settings, repository, workers, metrics, reloader, RecentAnswers(settings.cache))
            watching = asyncio.create_task(reloader.watch(settings.watch)) if settings.watch else None
            yield
            if watching:
                watching.cancel()
            workers.close()

    app = FastAPI(
        title="shapespace",
        version=__version__,
        summary="A handful of numbers in, a shape out.",
        lifespan=lifespan,
        middleware=_middleware(settings),
        generate_unique_id_function=lambda route: route.name,
        # Their pages load scripts from elsewhere.
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
    )
    problems.install(app)
    for module in (models, shapes, codes, interpolations, inference, health, operation, page):
        app.include_router(module.router)
    app.router.routes.append(page.assets())
    describe(app)
    return app


def _middleware(settings: Settings) -> list[Middleware]:
    """From the outside in."""
    stack = [
        Middleware(AnswerHead),
        Middleware(Observe),
        Middleware(LimitBody, limit=settings.max_body, upload=settings.max_upload),
    ]
    if settings.api_key:
        stack.insert(2, Middleware(RequireKey, key=settings.api_key))
    if settings.cors_origins:
        # Outermost, so that pages can read every refusal; a preflight brings no key.
        cors = Middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=["GET", "POST"],
            allow_headers=CORS_REQUEST,
            expose_headers=CORS_ANSWER,
        )
        stack.insert(0, cors)
    return stack
