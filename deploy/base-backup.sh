#!/bin/sh
# Writes a base backup named by the time into the archive, verifies it, and deletes older ones but the last, with the log
# that only they need. Options of pg_basebackup such as --host can be given.
set -eu
folder="${LINNA_WAL:-/wal}"
keep=2
name="$(date -u +%Y%m%dT%H%M%SZ)"
mkdir -p "$folder/base"
# Nothing stays of a backup that fails or is stopped.
trap 'rm -rf "${folder:?}/base/.$name.partial"' EXIT
trap 'exit 1' HUP INT TERM
pg_basebackup --pgdata "$folder/base/.$name.partial" --checkpoint fast "$@"
pg_verifybackup --quiet "$folder/base/.$name.partial"
date -u +%Y%m%dT%H%M%SZ > "$folder/base/.$name.partial/.ended"
mv "$folder/base/.$name.partial" "$folder/base/$name"
ls -1 "$folder/base" | sort | head -n "-$keep" | while read -r old; do rm -rf "${folder:?}/base/$old"; done
oldest="$(ls -1 "$folder/base" | sort | head -n 1)"
first="$(sed -n 's/^START WAL LOCATION: .*(file \([0-9A-F]*\))$/\1/p' "$folder/base/$oldest/backup_label")"
pg_archivecleanup "$folder" "$first"
echo "$folder/base/$name"
