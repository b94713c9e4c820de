#!/usr/bin/env bash
# integrations/openpi/setup.sh: an environment for openpi's client, which wants NumPy 1, with what
# madviz's toy needs, in integrations/openpi/.venv.
set -euo pipefail
cd "$(dirname "$0")"
python=${PYTHON:-python3}

"$python" -m venv .venv
.venv/bin/python -m pip install --disable-pip-version-check openpi-client==0.1.2 gymnasium msgspec \
  jaxtyping opencv-python-headless scipy tyro
.venv/bin/python -m pip install --disable-pip-version-check --no-deps --editable ../..
echo "integrations/openpi/.venv is ready"
