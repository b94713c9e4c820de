#!/usr/bin/env bash
# integrations/client_environment.sh NAME PACKAGE: makes integrations/NAME/.venv for the client that
# PACKAGE is, with madviz and what its toy needs. madviz's own packages are left out: their versions
# and the client's do not fit together. PYTHON=FILE takes another interpreter.
set -euo pipefail
name=$1 package=$2
cd "$(dirname "$0")/$name"

"${PYTHON:-python3}" -m venv .venv
add() { .venv/bin/python -m pip install --disable-pip-version-check "$@"; }
add "$package" gymnasium msgspec jaxtyping opencv-python-headless scipy tyro
add --no-deps --editable ../..
echo "integrations/$name/.venv is ready"
