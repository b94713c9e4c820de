#!/usr/bin/env bash
# integrations/vla_eval/setup.sh: an environment for vla-eval's harness with madviz's tasks in it, in
# integrations/vla_eval/.venv. This much is enough for the toy; for tasks on MuJoCo add
# metaworld==3.1.1 mujoco==3.3.0 packaging PyOpenGL fast-simplification trimesh.
set -euo pipefail
cd "$(dirname "$0")"
python=${PYTHON:-python3}

"$python" -m venv .venv
.venv/bin/python -m pip install --disable-pip-version-check vla-eval==0.8.0 gymnasium msgspec \
  jaxtyping opencv-python-headless scipy tyro
.venv/bin/python -m pip install --disable-pip-version-check --no-deps --editable ../..
echo "integrations/vla_eval/.venv is ready"
