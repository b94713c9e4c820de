#!/usr/bin/env bash
# tools/packages.sh WHAT: installs WHAT, for example '.[test]', into .venv at the versions of
# constraints.txt. Takes PYTHON and TORCH_INDEX from the environment; see the Makefile.
set -euo pipefail
what=$1
index=${TORCH_INDEX:-}
have_uv=$(command -v uv || true)

if [ ! -x .venv/bin/python ]; then
  cat <<'NOTICE'
Packages come next, into .venv here. Python's default torch brings CUDA libraries along: about 3 GB
to download, 6 GB on the disk, most of it for GPUs. On a machine without one, the smaller CPU build
(roughly 2 GB on the disk) does the same. To take it, stop now (Ctrl-C) and run
    make setup TORCH_INDEX=ADDRESS     with the index of torch's CPU builds (see pytorch.org), or
    UV_TORCH_BACKEND=cpu make setup    where uv is installed
NOTICE
  if [ -n "$have_uv" ]; then
    uv venv --quiet --allow-existing --python "${PYTHON:-python3}" .venv
  else
    "${PYTHON:-python3}" -m venv .venv
  fi
fi

add() {
  if [ -n "$have_uv" ]; then
    uv pip install --python .venv/bin/python --constraint constraints.txt "$@"
  else
    .venv/bin/python -m pip install --disable-pip-version-check --constraint constraints.txt "$@"
  fi
}

if [ -n "$index" ]; then
  # Only torch comes from there; what is installed already, the next line leaves alone.
  PIP_INDEX_URL=$index UV_DEFAULT_INDEX=$index add torch
fi
add --editable "$what"
