#!/bin/sh
# Starts a member: Patroni, which starts and watches PostgreSQL. Passwords go from secrets into a file that only it can read.
set -eu
here="$(cd "$(dirname "$0")" && pwd)"
secrets="${LINNA_SECRETS:-/run/secrets}"
configuration="${LINNA_PATRONI_CONFIGURATION:-/tmp/patroni.yml}"
# A password file that is missing or empty must not become an empty password.
password() {
  value="$(cat "$secrets/$1")" || exit 2
  [ -n "$value" ] || { echo "$secrets/$1: expected a password, found an empty file" >&2; exit 2; }
  # As YAML with single quotes.
  printf '%s' "$value" | sed "s/'/''/g"
}
superuser="$(password database_superuser_password)"
replication="$(password database_replication_password)"
umask 077
sed "s#/linna/#${here%/*}/#g" "$here/patroni.yml" > "$configuration"
cat >> "$configuration" <<YAML
  pgpass: $configuration.pgpass
  authentication:
    superuser: {username: postgres, password: '$superuser'}
    replication: {username: replicator, password: '$replication'}
restapi:
  authentication: {username: patroni, password: '$replication'}
YAML
exec patroni "$configuration"
