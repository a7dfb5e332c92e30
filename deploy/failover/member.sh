#!/bin/sh
# Start of the container of a member: owns the folders as root, then runs Patroni as the user of the server.
set -eu
mkdir -p "${LINNA_WAL:-/wal}/base" "${PATRONI_POSTGRESQL_DATA_DIR%/*}"
chown postgres:postgres "${LINNA_WAL:-/wal}" "${LINNA_WAL:-/wal}/base" "${PATRONI_POSTGRESQL_DATA_DIR%/*}" /run/postgresql
chmod 700 "${LINNA_WAL:-/wal}" "${PATRONI_POSTGRESQL_DATA_DIR%/*}"
PATRONI_POSTGRESQL_BIN_DIR="$(dirname "$(ls /usr/lib/postgresql/*/bin/postgres | tail -n 1)")"
export PATRONI_POSTGRESQL_BIN_DIR
exec gosu postgres sh /linna/failover/patroni.sh
