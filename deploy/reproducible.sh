#!/bin/sh
# Packs a source distribution again so that the same files give the same octets: names in order, one owner, one time
# (SOURCE_DATE_EPOCH), no name or time in the header of gzip. Use: SOURCE_DATE_EPOCH=... reproducible.sh FILE.tar.gz
set -eu
: "${SOURCE_DATE_EPOCH:?expected the time of the release in seconds since 1970}"
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
tar -xzf "$1" -C "$folder"
(cd "$folder" && tar --sort=name --format=gnu --mtime="@$SOURCE_DATE_EPOCH" --owner=0 --group=0 --numeric-owner \
  --mode=u+rw,go+r,go-w -cf - -- *) | gzip -n -9 > "$1.new"
mv "$1.new" "$1"
