# One image for the router, every service and the command line; the container's command says which. Builds on amd64 and
# arm64: every dependency has wheels for both.
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

COPY pyproject.toml README.md LICENSE src/
COPY docs src/docs
COPY shared src/shared
COPY services src/services
COPY zenav src/zenav
# what nothing needs at run time is left out, a third of the packages; libraries in numpy, scipy and *.libs do not survive strip.
# numpy and scipy each bring the same two libraries of Fortran, of builds with the same symbols: one is enough
ARG STRIP="llvmlite foxglove zenoh zstandard lz4 apsw pydantic_core cryptography msgpack numba backports"
ARG UNUSED="scipy/cluster scipy/datasets scipy/differentiate scipy/fftpack scipy/integrate scipy/interpolate scipy/io scipy/misc \
      scipy/odr scipy/signal scipy/stats scipy/special/cython_special* scipy/special/_test* scipy/_lib/_test_* \
      numpy/distutils numpy/_core/_simd* numpy/_core/_*_tests* numba/cuda numba/np/ufunc/tbbpool* numba/np/ufunc/omppool* \
      apsw/sqlite_extra_binaries zstandard/*cffi* cffi pycparser pygments/lexers/[!_p]* pygments/lexers/_*_builtins* \
      PIL/_avif* PIL/_webp* PIL/_imagingcms* PIL/_imagingtk* pillow.libs/libavif* pillow.libs/libwebp* pillow.libs/liblcms*"
RUN .venv/bin/pip install --no-deps --no-build-isolation --disable-pip-version-check -q ./src \
 && rm -rf src && .venv/bin/pip uninstall -q -y setuptools pip \
 && { command -v strip > /dev/null || { apt-get update -qq && apt-get install -y -qq --no-install-recommends binutils; }; } \
 && cd .venv/lib/python3*/site-packages \
 && rm -rf $UNUSED \
 && find $STRIP -name '*.so' -exec strip --strip-unneeded {} + \
 && for library in scipy.libs/libgfortran* scipy.libs/libquadmath*; do \
      name=${library#*/}; same=$(ls -d numpy.libs/${name%%-*}-* | head -n 1); \
      [ -n "$same" ] && ln -sf ../$same $library || exit 1; done \
 && find . -type d \( -name tests -o -name test -o -name __pycache__ \) -prune -exec rm -rf {} + \
 && find . -type f \( -name '*.pyi' -o -name '*.h' -o -name '*.pxd' -o -name '*.pyx' -o -name '*.c' -o -name '*.cpp' \
      -o -name '*.a' -o -name RECORD \) -delete
# what was left out is not missed by these imports; compiles the kernels, and the bytecode of what is imported
RUN .venv/bin/python -P -c 'import scipy.linalg, scipy.ndimage, scipy.optimize, scipy.spatial; \
      import kiss_icp.kiss_icp, rosbags.highlevel, rich.traceback, cryptography.x509, foxglove, lz4.frame, zstandard; \
      import PIL.Image, PIL.ImageFont, starlette, uvicorn' \
 && .venv/bin/python -P -m compileall -q .venv/lib/python3*/site-packages/services .venv/lib/python3*/site-packages/shared \
      .venv/lib/python3*/site-packages/zenav \
 && NUMBA_CACHE_DIR=/opt/zenav/kernels .venv/bin/python -P -m zenav.stack.warm \
 && .venv/bin/python -P -m zenav --help > /dev/null

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
