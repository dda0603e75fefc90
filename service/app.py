"""The application: wiring and lifespan, nothing else."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI
from threadpoolctl import threadpool_limits

from service import __version__, problems
from service.dependencies import Service
from service.middleware import BodyLimit
from service.openapi import describe
from service.repository import ModelRepository
from service.routes import health, interpolations, models, page, shapes
from service.settings import Settings
from service.workers import Workers


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
            app.state.service = Service(settings, repository, workers)
            yield
            workers.close()

    app = FastAPI(
        title="shapespace",
        version=__version__,
        summary="A handful of numbers in, a shape out.",
        lifespan=lifespan,
        generate_unique_id_function=lambda route: route.name,
        # Their pages load scripts from elsewhere.
        docs_url=None,
        redoc_url=None,
    )
    app.add_middleware(BodyLimit, limit=settings.max_body)
    problems.install(app)
    for module in (models, shapes, interpolations, health, page):
        app.include_router(module.router)
    app.router.routes.append(page.assets())
    describe(app)
    return app
