#!/bin/sh
# Checksums and signature of the files of a release.
#   release.sh sign FOLDER KEY            writes SHA256SUMS and its Ed25519 signature SHA256SUMS.sig
#   release.sh verify FOLDER PUBLIC_KEY   refuses changed, missing and added files
# Keys are in PEM format (openssl genpkey -algorithm ed25519); the private key stays outside of the repository.
# Exit status 0: done; 1: the files are not those that were signed; 2: wrong use.
set -eu
refused() { echo "REFUSED: $1" >&2; exit 1; }
misused() { echo "$1" >&2; exit 2; }

{ [ $# = 3 ] && [ -d "$2" ]; } || misused "expected: release.sh sign|verify FOLDER KEY"
[ -f "$3" ] || misused "$3: expected a key file, found none"
key="$(realpath "$3")"
repository="$(realpath "$(dirname "$0")/..")"
cd "$2"
case "$1" in
sign)
  case "$key" in "$repository"/*) misused "$3: expected a key outside of the repository, found it inside" ;; esac
  [ -z "$(find "$key" -perm /077)" ] || misused "$3: expected a key that only its owner can read; run 'chmod 600'"
  openssl pkey -in "$key" -passin pass: -noout -text 2> /dev/null | grep -q "^ED25519 Private" \
    || misused "$3: expected an Ed25519 key in PEM format without a password, found something else"
  for pattern in '*.whl' '*.tar.gz' '*.cdx.json' licences.txt; do
    found="$(find . -maxdepth 1 -name "$pattern" | wc -l)"
    [ "$found" -eq 1 ] || misused "$2: expected one $pattern, found $found"
  done
  find . -maxdepth 1 -type f ! -name SHA256SUMS ! -name SHA256SUMS.sig -printf '%f\n' | LC_ALL=C sort \
    | xargs -d '\n' sha256sum -- > SHA256SUMS
  openssl pkeyutl -sign -inkey "$key" -rawin -in SHA256SUMS -out SHA256SUMS.sig
  ;;
verify)
  for name in SHA256SUMS SHA256SUMS.sig; do [ -f "$name" ] || refused "$2/$name: expected the file, found none"; done
  openssl pkeyutl -verify -pubin -inkey "$key" -rawin -in SHA256SUMS -sigfile SHA256SUMS.sig > /dev/null 2>&1 \
    || refused "$2/SHA256SUMS: expected the signature of $3, found another"
  sha256sum --check --strict --quiet SHA256SUMS >&2 || refused "$2: expected the files that were signed, found others"
  for name in * .[!.]*; do
    [ -e "$name" ] || [ -L "$name" ] || continue
    [ ! -L "$name" ] || refused "$2/$name: expected a plain file, found a link"
    case "$name" in
    SHA256SUMS | SHA256SUMS.sig) ;;
    *) cut -c 67- SHA256SUMS | grep -qxF -e "$name" || refused "$2/$name: expected signed files only, found one that is not listed" ;;
    esac
  done
  ;;
*) misused "$1: expected sign or verify" ;;
esac
echo "$2: $(wc -l < SHA256SUMS) files"
