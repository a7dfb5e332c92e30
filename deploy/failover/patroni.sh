#!/bin/sh
# Starts a member: Patroni, which starts and watches PostgreSQL. Passwords go from secrets into a file that only it can read.
set -eu
here="$(cd "$(dirname "$0")" && pwd)"
secrets="${LINNA_SECRETS:-/run/secrets}"
configuration="${LINNA_PATRONI_CONFIGURATION:-/tmp/patroni.yml}"
umask 077
sed "s#/linna/#${here%/*}/#g" "$here/patroni.yml" > "$configuration"
cat >> "$configuration" <<YAML
  pgpass: $configuration.pgpass
  authentication:
    superuser: {username: postgres, password: "$(cat "$secrets/database_superuser_password")"}
    replication: {username: replicator, password: "$(cat "$secrets/database_replication_password")"}
restapi:
  authentication: {username: patroni, password: "$(cat "$secrets/database_replication_password")"}
YAML
exec patroni "$configuration"
