# The ground service and the command line; the same image serves, works and migrates.
# Another base (one pinned by its digest, or from a mirror) can be given: --build-arg PYTHON_IMAGE=...@sha256:...
ARG PYTHON_IMAGE=python:3.11.14-slim-bookworm
ARG NODE_IMAGE=node:20.19.5-bookworm-slim

# Telemetry displays: one package without dependencies, by version and checksum; its source maps are not served.
FROM ${NODE_IMAGE} AS displays
WORKDIR /displays
COPY deploy/openmct/package.json deploy/openmct/package-lock.json ./
RUN npm ci --ignore-scripts --no-audit --no-fund \
    && mkdir openmct && cp -r node_modules/openmct/dist node_modules/openmct/package.json node_modules/openmct/LICENSE.md openmct \
    && find openmct -name '*.map' -delete

FROM ${PYTHON_IMAGE} AS sources
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/linna
WORKDIR /src
COPY requirements/hashed requirements
RUN /opt/linna/bin/pip install --require-hashes -r requirements/runtime.txt -r requirements/postgres.txt \
    -r requirements/parquet.txt -r requirements/traces.txt -r requirements/oidc.txt -r requirements/objects.txt \
    -r requirements/terrain.txt -r requirements/exports.txt
COPY pyproject.toml README.md LICENSE ./
COPY kernels kernels
COPY lunar lunar
COPY tmtc tmtc
COPY reports reports
COPY payload_emulator payload_emulator
COPY studies studies
COPY ground_service ground_service
COPY linna linna
COPY db db
COPY scenarios scenarios

# The documentation, with the pages that the program generates; its tools stay in this stage.
FROM sources AS help
RUN /opt/linna/bin/pip install --require-hashes -r requirements/site.txt
COPY mkdocs.yml docs_site.py ./
COPY docs docs
RUN NO_MKDOCS_2_WARNING=1 /opt/linna/bin/python -m mkdocs build --strict

FROM sources AS build
COPY --from=help /src/ground_service/web/help ground_service/web/help
RUN /opt/linna/bin/pip install --no-deps .

FROM ${PYTHON_IMAGE}
LABEL org.opencontainers.image.title="linna" org.opencontainers.image.licenses="Apache-2.0"
# The sandbox of payload builds.
RUN apt-get update && apt-get install -y --no-install-recommends bubblewrap && rm -rf /var/lib/apt/lists/*
RUN groupadd --gid 10001 linna && useradd --uid 10001 --gid linna --create-home linna \
    && mkdir /var/lib/linna /exchange /backup && chown linna:linna /var/lib/linna /exchange /backup \
    && chmod 2770 /exchange && chmod 700 /backup
COPY --from=build /opt/linna /opt/linna
COPY --from=displays /displays/openmct /opt/linna/share/openmct
ENV PATH=/opt/linna/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    MPLBACKEND=Agg \
    MPLCONFIGDIR=/tmp/matplotlib \
    NUMBA_CACHE_DIR=/var/lib/linna/.numba \
    LINNA_HOME=/var/lib/linna \
    LINNA_OPENMCT=/opt/linna/share/openmct
USER 10001:10001
WORKDIR /var/lib/linna
VOLUME /var/lib/linna
EXPOSE 8042
ENTRYPOINT ["linna"]
CMD ["--help"]
