"""The application: its parts, their start and their end."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager

from fastapi import Depends, FastAPI
from prometheus_client import CollectorRegistry
from starlette.middleware import Middleware

from shapespace import __version__
from shapespace.service.http import error_handlers
from shapespace.service.http.caching import AnswerCache
from shapespace.service.http.connections import Connections
from shapespace.service.http.dependencies import Service, known_query
from shapespace.service.http.description import describe
from shapespace.service.http.middleware.access import AcceptWholeAddress, CrossOrigin, RequireHost, RequireKey
from shapespace.service.http.middleware.compress import Compress
from shapespace.service.http.middleware.memory import LimitBody, LimitUnreadAnswers
from shapespace.service.http.middleware.observe import QUIET, Observe
from shapespace.service.http.routes import codes, interpolations, models, open_inference, operation, page, shapes
from shapespace.service.limits.quota import UPLOADS
from shapespace.service.limits.sandbox import READ, Sandbox
from shapespace.service.limits.workers import Workers
from shapespace.service.operation.metrics import Metrics
from shapespace.service.operation.reloading import Reloader
from shapespace.service.repository.repository import ModelRepository
from shapespace.service.repository.validation import BundleValidator
from shapespace.service.settings import Settings, is_loopback
from shapespace.solve.blas_threads import OneBlasThread

#: Headers that pages of other origins may send, and headers of answers that they may read.
CORS_REQUEST = ["Authorization", "Content-Type", "If-None-Match", "Inference-Header-Content-Length"]
CORS_REQUEST += ["X-API-Key", "X-Request-ID"]
CORS_ANSWER = ["Content-Disposition", "Content-Location", "ETag", "Inference-Header-Content-Length", "Location"]
CORS_ANSWER += ["Model-Version", "Retry-After", "Server-Timing", "Shape-Color", "Shape-Diagnostics", "X-Request-ID"]
#: Host names of the loopback interface.
LOOPBACK = ("localhost", "127.0.0.1", "[::1]")


def create_app(settings: Settings | None = None, validator: BundleValidator | None = None) -> FastAPI:
    """Return the service as an ASGI application, with settings from the environment by default.

    It loads the bundles when it starts, and takes over a validation of them that has begun already.
    """
    settings = settings or Settings()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        # BLAS computes in the thread that calls it: its own threads would multiply with the workers.
        with OneBlasThread():
            workers = Workers(settings.workers, settings.queue, settings.deadline)
            connections = Connections(settings.max_connections, settings.deadline, settings.trusted_proxies)
            repository = ModelRepository(
                settings.models_dir,
                workers.threads,
                validator,
                settings.default_versions,
                settings.default_versions_file,
            )
            metrics = Metrics(app.state.metrics, repository, workers, connections.quota)
            connections.on_refusal = metrics.refused
            reloader = Reloader(repository, metrics)
            answers = AnswerCache(settings.cache)
            sandbox = Sandbox(min(settings.workers, UPLOADS), READ)
            sandbox.prepare()
            app.state.service = Service(settings, repository, workers, connections, metrics, reloader, answers, sandbox)
            # Threads that read bodies and folders, apart from the workers.
            asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(2, thread_name_prefix="reading"))
            watching = asyncio.create_task(reloader.watch(settings.watch)) if settings.watch else None
            yield
            if watching:
                watching.cancel()
            repository.close()
            sandbox.close()
            workers.close()

    app = FastAPI(
        title="shapespace",
        version=__version__,
        summary="A few numbers become a 3D shape.",
        lifespan=lifespan,
        redirect_slashes=False,  # a redirect says nothing, and behind a proxy it may lead elsewhere
        middleware=_middleware(settings),
        dependencies=[Depends(known_query)],
        # Spans of OpenTelemetry, where a provider is configured. The stages of an answer have spans of their own.
        telemetry={"operation_spans": False, "exclude": lambda scope: scope.get("path") in QUIET},
        generate_unique_id_function=lambda route: route.name,
        # FastAPI's pages load scripts from other servers.
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
    )
    app.state.metrics = CollectorRegistry()
    error_handlers.install(app)
    calls = (models, shapes, codes, interpolations, open_inference, operation, page)
    routers = [module.router for module in calls]
    for router in routers:
        app.include_router(router)
    app.router.routes.append(page.assets())
    describe(app, routers)
    return app


def _middleware(settings: Settings) -> list[Middleware]:
    """Return the middleware, from the outermost to the innermost."""
    stack = [
        Middleware(Observe),
        Middleware(LimitUnreadAnswers),
        Middleware(Compress),
        *([Middleware(RequireHost, hosts=hosts)] if (hosts := _hosts(settings)) else []),
        *([Middleware(RequireKey, key=settings.api_key)] if settings.api_key else []),
        Middleware(LimitBody, limit=settings.max_body, upload=settings.max_upload),
    ]
    if settings.cors_origins:
        # Outermost, so that pages can read every refusal, and because a preflight has no key.
        cors = Middleware(
            CrossOrigin,
            allow_origins=settings.cors_origins,
            allow_methods=["GET", "POST"],
            allow_headers=CORS_REQUEST,
            expose_headers=CORS_ANSWER,
        )
        stack.insert(0, cors)
    return [Middleware(AcceptWholeAddress), *stack]


def _hosts(settings: Settings) -> tuple[str, ...]:
    """Return the accepted host names; none accepts all."""
    given = tuple(host.lower() for host in settings.hosts)
    if "*" in given:
        return ()
    # With a key, pages of other sites get no answer. A server for other machines cannot know its names.
    open_to_all = settings.api_key is not None or not is_loopback(settings.host)
    return given or (() if open_to_all else (*LOOPBACK, settings.host.lower()))
