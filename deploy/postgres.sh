#!/bin/sh
# Starts PostgreSQL with an archive of its write-ahead log, for recovery to any time (deploy/restore-to.sh).
set -eu
wal="${LINNA_WAL:-/wal}"
mkdir -p "$wal/base"
chown -R postgres:postgres "$wal"
chmod 700 "$wal"
# A segment is archived when it is full, and every 60 s: so much is lost with the disk of the database.
# Every process may open 30 connections (ground_service/store/database.py).
exec docker-entrypoint.sh postgres -c max_connections=300 -c wal_level=replica -c archive_mode=on -c archive_timeout=60 \
  -c archive_command='sh /linna/wal-archive.sh "%p" "%f"' "$@"
