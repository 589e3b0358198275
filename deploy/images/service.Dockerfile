# One image per process, with only its own dependencies. Build arguments: MEMBER (folder), NAME (distribution), MODULE
# (what `python -m` starts), KERNELS (profile of fog_kernels.warm, or "none"), REVISION (the commit, for the metric
# fognav_build_info).
#     docker build -f deploy/images/service.Dockerfile --build-arg MEMBER=services/planner ... .
FROM python:3.11-slim-bookworm AS wheels
WORKDIR /src
COPY requirements/build.txt requirements/
RUN pip install --no-cache-dir --require-hashes -r requirements/build.txt
COPY VERSION .
COPY libs libs
ARG MEMBER
COPY ${MEMBER} ${MEMBER}
RUN pip wheel --no-cache-dir --no-deps --no-build-isolation -w /wheels libs/*/ ./${MEMBER}

FROM python:3.11-slim-bookworm
ARG NAME
ARG MODULE
ARG KERNELS=none
RUN useradd --system --uid 10001 --home-dir /var/lib/fognav --create-home fognav \
    && mkdir -p /var/cache/fognav /run/fognav && chown fognav: /var/cache/fognav /run/fognav
COPY requirements/${NAME}.txt /tmp/requirements.txt
RUN pip install --no-cache-dir --require-hashes -r /tmp/requirements.txt
COPY --from=wheels /wheels /tmp/wheels
# Only the workspace libraries that this member declares: kernels (numba) stay out of images that don't need them.
RUN set -e; pip install --no-cache-dir --no-deps /tmp/wheels/fog_contracts-*.whl /tmp/wheels/fog_runtime-*.whl; \
    if [ "${KERNELS}" != none ]; then pip install --no-cache-dir --no-deps /tmp/wheels/fog_kernels-*.whl; fi; \
    pip install --no-cache-dir --no-deps /tmp/wheels/"$(echo "${NAME}" | tr - _)"-*.whl; \
    python -c "import importlib, sys; importlib.import_module(sys.argv[1])" "${MODULE}"; rm -rf /tmp/wheels
COPY deploy/images/start /usr/local/bin/fognav-start
COPY deploy/images/ready /usr/local/bin/fognav-ready
ARG REVISION
ENV FOGNAV_REVISION=${REVISION} FOGNAV_MODULE=${MODULE} FOGNAV_KERNELS=${KERNELS} \
    FOGNAV_HTTP_HOST=0.0.0.0 FOGNAV_HTTP_PORT=8000 FOGNAV_DATA_DIR=/var/lib/fognav \
    NUMBA_CACHE_DIR=/var/cache/fognav/numba PYTHONUNBUFFERED=1
USER fognav
EXPOSE 8000
HEALTHCHECK --interval=5s --timeout=3s --start-period=60s --retries=3 \
    CMD ["fognav-ready", "8000", "/readyz"]
ENTRYPOINT ["fognav-start"]
