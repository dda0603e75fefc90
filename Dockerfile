# Named once, so that `--from` can put another base in its place where no registry is reachable.
FROM python:3.11-slim-bookworm AS base

FROM base AS build
RUN python -m venv /opt/shapespace
ENV PATH=/opt/shapespace/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
# Dependencies first: they are large and change seldom. The secret is an optional pip.conf for private indexes;
# versions are pyproject.toml's to state.
COPY pyproject.toml README.md LICENSE ./
# hadolint ignore=DL3013
RUN --mount=type=secret,id=pip,target=/etc/pip.conf pip install '.[serve]'
COPY geometry geometry
COPY service service
RUN --mount=type=secret,id=pip,target=/etc/pip.conf pip install --no-deps --force-reinstall .

FROM base
COPY --from=build /opt/shapespace /opt/shapespace
WORKDIR /srv/shapespace
COPY models models
# Nothing is written at run time, so the root file system may be read-only.
ENV PATH=/opt/shapespace/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    ORT_DISABLE_TELEMETRY=1 \
    SHAPESPACE_HOST=0.0.0.0 \
    SHAPESPACE_PORT=8000
USER 10001:10001
EXPOSE 8000
# Not urllib: it would ask a configured proxy.
HEALTHCHECK --interval=30s --timeout=5s --start-period=30s CMD ["python", "-c", "\
import http.client, os, sys; \
server = http.client.HTTPConnection('127.0.0.1', int(os.environ['SHAPESPACE_PORT']), timeout=4); \
server.request('GET', '/v2/health/ready'); \
sys.exit(server.getresponse().status != 200)"]
CMD ["shapespace-serve"]
