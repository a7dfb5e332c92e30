#!/bin/sh
# Writes requirements/hashed/ from requirements/: the same versions with the SHA-256 of every file of the package index.
# Needs uv (https://docs.astral.sh/uv/).
set -eu
cd "$(dirname "$0")/.."
mkdir -p requirements/hashed
for name in runtime postgres parquet traces oidc objects terrain exports site; do
  uv pip compile --quiet --no-deps --generate-hashes --no-annotate --no-header --universal --python-version 3.11 \
    "requirements/$name.txt" --output-file "requirements/hashed/$name.txt"
done
