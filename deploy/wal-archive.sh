#!/bin/sh
# archive_command: copies the segment at path $1 to the archive as $2, durably. A segment that is there already must be
# equal, or the command fails and PostgreSQL keeps the segment.
set -eu
folder="${LINNA_WAL:-/wal}"
if [ -e "$folder/$2" ]; then
  exec cmp -s "$1" "$folder/$2"
fi
cp "$1" "$folder/.$2.partial"
sync "$folder/.$2.partial"
mv "$folder/.$2.partial" "$folder/$2"
sync "$folder"
