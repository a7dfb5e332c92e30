#!/bin/sh
# Starts the broker with one user that can do what a queue needs, its lock scripts included: no settings, files, or other
# administration.
set -eu
secrets="${LINNA_SECRETS:-/run/secrets}"
# A password file that is missing or empty must not become an empty password.
password() {
  value="$(cat "$secrets/$1")" || exit 2
  [ -n "$value" ] || { echo "$secrets/$1: expected a password, found an empty file" >&2; exit 2; }
  printf '%s' "$value"
}
password="$(password broker_password)"
hash="$(printf '%s' "$password" | sha256sum | cut -d ' ' -f 1)"
users="${LINNA_REDIS_USERS:-/tmp/users.acl}"
umask 077
rights='-@all +@read +@write +@connection +@transaction +@pubsub +@blocking -@dangerous +info +time +eval +evalsha +script|load +script|exists'
printf 'user default off\nuser linna on #%s ~* &* %s\n' "$hash" "$rights" > "$users"
exec redis-server --aclfile "$users" --appendonly yes "$@"
