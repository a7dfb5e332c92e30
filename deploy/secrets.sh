#!/bin/sh
# Makes the secrets of docker-compose.yml in a folder that only its owner can enter; those that are there are kept.
# A variable gives a secret its value; the others are drawn at random.
set -eu
folder="${LINNA_SECRETS_DIR:-secrets}"
umask 077
mkdir -p "$folder"
chmod 700 "$folder"
secret() {
  [ -s "$folder/$1" ] && return
  value="$2"
  [ -n "$value" ] || value="$(od -An -N24 -tx1 /dev/urandom | tr -d ' \n')"
  printf '%s' "$value" > "$folder/$1"
  # Containers read it as users of their own, through a mount of this file alone.
  chmod 444 "$folder/$1"
}
secret database_superuser_password ''
secret database_owner_password "${LINNA_DB_OWNER_PASSWORD:-}"
secret database_password "${LINNA_DB_PASSWORD:-}"
secret database_backup_password "${LINNA_DB_BACKUP_PASSWORD:-}"
secret broker_password "${LINNA_REDIS_PASSWORD:-}"
secret admin_token "${LINNA_ADMIN_TOKEN:-}"
# Of optional parts: empty until a setting names them.
for name in objects_access_key objects_secret_key oidc_client_secret; do
  [ -e "$folder/$name" ] || { : > "$folder/$name"; chmod 444 "$folder/$name"; }
done
# The folder is mounted whole, so that a renewed certificate is seen.
tls="$folder/tls"
mkdir -p "$tls"
chmod 755 "$tls"
for pair in certificate:key key:certificate; do
  if [ -s "$tls/${pair%:*}" ] && [ ! -s "$tls/${pair#*:}" ]; then
    echo "secrets: expected $tls/${pair#*:} for $tls/${pair%:*}, found none" >&2
    exit 2
  fi
done
# Without a certificate of a certification authority, the proxy gets one that it signs itself, for this name.
if [ ! -s "$tls/certificate" ]; then
  name="${LINNA_HOST_NAME:-localhost}"
  rm -f "$tls/certificate" "$tls/key"
  said="$(openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 365 -subj "/CN=$name" \
    -addext "subjectAltName=DNS:$name,IP:127.0.0.1" -keyout "$tls/key" -out "$tls/certificate" 2>&1)" || {
    rm -f "$tls/certificate" "$tls/key"
    printf 'secrets: no certificate was made for %s:\n%s\n' "$name" "$said" >&2
    exit 1
  }
  chmod 444 "$tls/certificate" "$tls/key"
fi
echo "secrets are in $folder; the token of the user admin is in $folder/admin_token"
