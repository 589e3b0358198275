#!/bin/sh
# Build local images that replace the third-party images of docker-compose.yml, for engines that can't reach an image
# registry. They contain Debian's packages of the same programs, and match the originals in what the compose file and
# the mounted configuration rely on: user and uid, entry point, folders and their owners. Their names differ, so that
# nobody mistakes them for the originals.
#
#     tests/compose/stand_ins.sh          builds the missing ones of fognav-stand-in/mosquitto, /redis, /caddy and /prometheus
#
# Needs a Debian base image of the name below, and Debian's package servers through the host's network.
set -eu
base=${FOGNAV_STAND_IN_BASE:-debian:bookworm-slim}

stand_in() { # NAME, with the Dockerfile on standard input
    docker image inspect "$1" >/dev/null 2>&1 || docker build --quiet --network host --tag "$1" - >/dev/null
}

stand_in fognav-stand-in/mosquitto <<DOCKERFILE
FROM $base
RUN groupadd --system --gid 1883 mosquitto && useradd --system --uid 1883 --gid 1883 --home-dir /mosquitto mosquitto \\
    && apt-get update -qq \\
    && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends mosquitto mosquitto-clients \\
       >/dev/null \\
    && rm -rf /var/lib/apt/lists/* && mkdir -p /mosquitto/config /mosquitto/data /mosquitto/log \\
    && chown -R mosquitto:mosquitto /mosquitto
VOLUME ["/mosquitto/data", "/mosquitto/log"]
EXPOSE 8883
CMD ["/usr/sbin/mosquitto", "-c", "/mosquitto/config/mosquitto.conf"]
DOCKERFILE

stand_in fognav-stand-in/redis <<DOCKERFILE
FROM $base
RUN groupadd --system --gid 999 redis && useradd --system --uid 999 --gid redis --home-dir /data redis \\
    && apt-get update -qq \\
    && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends redis-server >/dev/null \\
    && rm -rf /var/lib/apt/lists/* && mkdir -p /data && chown redis:redis /data
VOLUME ["/data"]
WORKDIR /data
EXPOSE 6379
CMD ["redis-server"]
DOCKERFILE

# The original's program has this capability in its file, without which it can't be started; hence cap_add.
stand_in fognav-stand-in/caddy <<DOCKERFILE
FROM $base
RUN apt-get update -qq \\
    && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends caddy busybox libcap2-bin \\
       >/dev/null \\
    && rm -rf /var/lib/apt/lists/* && ln -s /bin/busybox /usr/local/bin/wget \\
    && setcap cap_net_bind_service=+ep /usr/bin/caddy && mkdir -p /config/caddy /data/caddy
WORKDIR /srv
EXPOSE 80 443
CMD ["caddy", "run", "--config", "/etc/caddy/Caddyfile", "--adapter", "caddyfile"]
DOCKERFILE

# Busybox provides the wget that the original has for healthchecks.
stand_in fognav-stand-in/prometheus <<DOCKERFILE
FROM $base
RUN apt-get update -qq \\
    && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends prometheus busybox >/dev/null \\
    && rm -rf /var/lib/apt/lists/* /etc/prometheus/* && ln -s /bin/busybox /usr/local/bin/wget \\
    && mkdir -p /prometheus && chown nobody:nogroup /prometheus
VOLUME ["/prometheus"]
USER nobody
WORKDIR /prometheus
EXPOSE 9090
ENTRYPOINT ["/bin/prometheus"]
CMD ["--config.file=/etc/prometheus/prometheus.yml", "--storage.tsdb.path=/prometheus"]
DOCKERFILE
