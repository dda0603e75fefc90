# Python 3.11.17. The digest belongs to the index, which has an image for every processor;
# `docker buildx imagetools inspect python:3.11-slim-bookworm` prints a newer one. The base has its own stage, so that
# `--from` can replace it where no registry is reachable.
FROM python:3.11-slim-bookworm@sha256:0a310eeecf4e1f5a0743f9a6520c90c88d089c903ca5fd283f501e3a805f5f89 AS base

FROM base AS build
# Two environments: the build environment stays in this stage, and the server environment has no pip and no setuptools.
RUN python -m venv /opt/build && python -m venv --without-pip /opt/shapespace
ENV PATH=/opt/build/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
# Dependencies first: they are large and rarely change. The secret is an optional pip.conf for private indexes.
# EXTRA=serve-without-mkl makes an image with 0.5 GB less, which solves more slowly.
ARG EXTRA=serve
COPY requirements/build.txt requirements/${EXTRA}.txt requirements/
COPY scripts/slim.py scripts/
RUN --mount=type=secret,id=pip,target=/etc/pip.conf \
    pip install --require-hashes --requirement requirements/build.txt && \
    pip --python /opt/shapespace install --require-hashes --requirement "requirements/${EXTRA}.txt" && \
    python scripts/slim.py /opt/shapespace
COPY pyproject.toml setup.py README.md LICENSE ./
COPY shapespace shapespace
COPY service service
RUN pip wheel --no-deps --no-index --no-build-isolation --wheel-dir wheels . && \
    pip --python /opt/shapespace install --no-deps --no-index wheels/*.whl

FROM base
COPY --from=build /opt/shapespace /opt/shapespace
WORKDIR /srv/shapespace
COPY models models
# The server writes nothing, so the root file system may be read-only.
ENV PATH=/opt/shapespace/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    ORT_DISABLE_TELEMETRY=1 \
    SHAPESPACE_HOST=0.0.0.0 \
    SHAPESPACE_PORT=8000
USER 10001:10001
EXPOSE 8000
# http.client instead of urllib, which would use a configured proxy.
HEALTHCHECK --interval=30s --timeout=5s --start-period=30s CMD ["python", "-c", "\
import http.client, os, sys; \
server = http.client.HTTPConnection('127.0.0.1', int(os.environ['SHAPESPACE_PORT']), timeout=4); \
server.request('GET', '/v2/health/ready'); \
sys.exit(server.getresponse().status != 200)"]
CMD ["shapespace-serve"]
