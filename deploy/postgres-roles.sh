#!/bin/sh
# Makes the roles of owner, service and backup in a new database; `linna db upgrade` grants the rights of the last two.
set -eu
secrets="${LINNA_SECRETS:-/run/secrets}"
psql --username "$POSTGRES_USER" --dbname "$POSTGRES_DB" --set ON_ERROR_STOP=1 \
  --set password="$(cat "$secrets/database_password")" \
  --set owner_password="$(cat "$secrets/database_owner_password")" \
  --set backup_password="$(cat "$secrets/database_backup_password")" <<'SQL'
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
