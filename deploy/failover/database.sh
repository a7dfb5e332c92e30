#!/bin/sh
# Creates the database and its roles in a new cluster; $1 is the connection to its superuser.
set -eu
here="$(cd "$(dirname "$0")" && pwd)"
psql "$1" --set ON_ERROR_STOP=1 --command 'CREATE DATABASE linna'
POSTGRES_USER=postgres POSTGRES_DB="$1 dbname=linna" sh "${here%/*}/postgres-roles.sh"
