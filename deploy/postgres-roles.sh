#!/bin/sh
# Makes the roles of owner, service and backup in a new database; `linna db upgrade` grants the rights of the last two.
set -eu
secrets="${LINNA_SECRETS:-/run/secrets}"
# A password file that is missing or empty must not become an empty password.
password() {
  value="$(cat "$secrets/$1")" || exit 2
  [ -n "$value" ] || { echo "$secrets/$1: expected a password, found an empty file" >&2; exit 2; }
  printf '%s' "$value"
}
password="$(password database_password)"
owner_password="$(password database_owner_password)"
backup_password="$(password database_backup_password)"
psql --username "$POSTGRES_USER" --dbname "$POSTGRES_DB" --set ON_ERROR_STOP=1 \
  --set password="$password" --set owner_password="$owner_password" --set backup_password="$backup_password" <<'SQL'
CREATE ROLE linna_owner LOGIN NOSUPERUSER NOCREATEDB NOCREATEROLE NOREPLICATION PASSWORD :'owner_password';
CREATE ROLE linna LOGIN NOSUPERUSER NOCREATEDB NOCREATEROLE NOREPLICATION PASSWORD :'password';
CREATE ROLE linna_backup LOGIN NOSUPERUSER NOCREATEDB NOCREATEROLE NOREPLICATION PASSWORD :'backup_password';
ALTER ROLE linna_backup SET default_transaction_read_only = on;
ALTER DATABASE linna OWNER TO linna_owner;
ALTER SCHEMA public OWNER TO linna_owner;
REVOKE ALL ON DATABASE linna FROM PUBLIC;
GRANT CONNECT, TEMPORARY ON DATABASE linna TO linna;
GRANT CONNECT ON DATABASE linna TO linna_backup;
SQL
