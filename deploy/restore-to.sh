#!/bin/sh
# restore-to.sh DATA TIME: fills the empty data folder DATA so that PostgreSQL, when it starts, recovers to TIME, such as
# "2029-08-07 06:00:00+00", from the newest base backup before it. Transactions committed after TIME are not in it.
set -eu
folder="${LINNA_WAL:-/wal}"
data="$1"
target="$2"
if [ -e "$data" ] && [ -n "$(ls -A "$data")" ]; then
  echo "$data: expected an empty folder, found something in it" >&2
  exit 2
fi
limit="$(date -u -d "$target" +%Y%m%dT%H%M%SZ)" || { echo "expected a time with a zone, found $target" >&2; exit 2; }
base=''
for one in $(ls -1 "$folder/base" | sort); do
  # A backup is usable from its end on.
  ended="$(cat "$folder/base/$one/.ended" 2>/dev/null || echo "$one")"
  if [ "$(printf '%s\n%s\n' "$ended" "$limit" | sort | head -n 1)" = "$ended" ]; then base="$one"; fi
done
if [ -z "$base" ]; then
  echo "$folder/base: expected a base backup before $target, found none" >&2
  exit 2
fi
pg_verifybackup --quiet --ignore .ended "$folder/base/$base"
mkdir -p "$data"
cp -a "$folder/base/$base/." "$data/"
rm -f "$data/.ended"
chmod 700 "$data"
cat >> "$data/postgresql.auto.conf" <<CONF
restore_command = 'cp "$folder/%f" "%p"'
recovery_target_time = '$target'
recovery_target_action = 'promote'
CONF
touch "$data/recovery.signal"
echo "$data: $base, to be recovered to $target at the start of PostgreSQL"
