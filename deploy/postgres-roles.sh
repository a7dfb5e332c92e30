#!/bin/sh
# Makes the role of the service in a new database; `linna db upgrade` grants it its rights afterwards.
set -eu
psql --username "$POSTGRES_USER" --dbname "$POSTGRES_DB" --set ON_ERROR_STOP=1 \
  --set password="$(cat /run/secrets/database_password)" \
  --set owner_password="$(cat /run/secrets/database_owner_password)" <<'SQL'
CREATE ROLE linna_owner LOGIN NOSUPERUSER NOCREATEDB NOCREATEROLE NOREPLICATION PASSWORD :'owner_password';
CREATE ROLE linna LOGIN NOSUPERUSER NOCREATEDB NOCREATEROLE NOREPLICATION PASSWORD :'password';
ALTER DATABASE linna OWNER TO linna_owner;
ALTER SCHEMA public OWNER TO linna_owner;
REVOKE ALL ON DATABASE linna FROM PUBLIC;
GRANT CONNECT, TEMPORARY ON DATABASE linna TO linna;
SQL
