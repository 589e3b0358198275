# A simulated robot and its sensor nodes: simulator, watchdog, guardian and agent in one container, because containers
# can't share ptys.
FROM python:3.11-slim-bookworm AS wheels
WORKDIR /src
COPY requirements/build.txt requirements/
RUN pip install --no-cache-dir --require-hashes -r requirements/build.txt
COPY VERSION .
COPY libs libs
COPY robot-agent robot-agent
COPY sim sim
RUN pip wheel --no-cache-dir --no-deps --no-build-isolation -w /wheels libs/*/ ./robot-agent ./sim

FROM python:3.11-slim-bookworm
RUN useradd --system --uid 10001 --home-dir /var/lib/fognav --create-home fognav \
    && mkdir -p /var/cache/fognav /run/fognav && chown fognav: /var/cache/fognav /run/fognav
COPY requirements/fognav-sim.txt /tmp/requirements.txt
RUN pip install --no-cache-dir --require-hashes -r /tmp/requirements.txt
COPY --from=wheels /wheels /tmp/wheels
RUN pip install --no-cache-dir --no-deps /tmp/wheels/*.whl && rm -rf /tmp/wheels
COPY deploy/images/start /usr/local/bin/fognav-start
COPY deploy/images/ready /usr/local/bin/fognav-ready
ARG REVISION
ENV FOGNAV_REVISION=${REVISION} FOGNAV_MODULE=fognav_sim.robot_unit FOGNAV_KERNELS=all FOGNAV_HTTP_HOST=0.0.0.0 FOGNAV_DATA_DIR=/var/lib/fognav \
    FOGNAV_RUN_DIR=/tmp/fognav NUMBA_CACHE_DIR=/var/cache/fognav/numba PYTHONUNBUFFERED=1
USER fognav
EXPOSE 9100
HEALTHCHECK --interval=5s --timeout=3s --start-period=120s --retries=3 \
    CMD ["sh", "-c", "fognav-ready 9100 /readyz && fognav-ready 9101 /readyz"]
ENTRYPOINT ["fognav-start"]
