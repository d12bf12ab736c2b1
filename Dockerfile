# One image for the router, every service and the command line; the container's command says which.
#
# Kernels are compiled for any x86-64 processor with AVX2 (shared/repeatable.py), or for the ARM that builds the image. On
# another one the first start compiles them again: the cache is the user's own, so it can.
FROM python:3.11-slim-bookworm AS build

# a package mirror, where one is needed: given at build time, kept nowhere
ARG PIP_INDEX_URL
ARG PIP_EXTRA_INDEX_URL
ARG PIP_TRUSTED_HOST

WORKDIR /opt/zenav
RUN python -m venv .venv
COPY requirements.txt ./
RUN .venv/bin/pip install --no-cache-dir --disable-pip-version-check -q -r requirements.txt

COPY pyproject.toml README.md ./
COPY config config
COPY shared shared
COPY services services
COPY zenav zenav
# numba's cache holds for the exact time of a source file, and image layers keep whole seconds only
RUN .venv/bin/pip install --no-deps --no-build-isolation --disable-pip-version-check -q -e . \
 && find . -path ./.venv -prune -o -name '*.py' -exec touch -d 2020-01-01 {} + \
 && .venv/bin/python -m compileall -q shared services zenav \
 && NUMBA_CACHE_DIR=/opt/zenav/kernels .venv/bin/python -m zenav.warm

FROM python:3.11-slim-bookworm

RUN useradd --uid 1000 --create-home zenav \
 && install -d -o zenav -g zenav /home/zenav/maps /home/zenav/recordings
COPY --from=build --chown=zenav:zenav /opt/zenav /opt/zenav
ENV PATH=/opt/zenav/.venv/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/opt/zenav/kernels
USER zenav
WORKDIR /home/zenav
VOLUME ["/home/zenav/maps", "/home/zenav/recordings"]
CMD ["zenav", "--help"]
