#!/usr/bin/env bash
# integrations/lerobot/setup.sh: an environment for LeRobot with madviz's tasks and server in it, in
# integrations/lerobot/.venv. LeRobot 0.6 wants Python 3.12 and other versions of torch, NumPy and
# OpenCV than all of madviz, so only that part of madviz is installed which needs none of them.
set -euo pipefail
cd "$(dirname "$0")"
root=../..
python=${PYTHON:-python3.12}

if command -v uv >/dev/null; then
  uv venv --quiet --allow-existing --python "$python" .venv
  add() { uv pip install --python .venv/bin/python "$@"; }
else
  "$python" -m venv .venv
  add() { .venv/bin/python -m pip install --disable-pip-version-check "$@"; }
fi

add 'lerobot[training,dataset]==0.6.1'
# What madviz's tasks on MuJoCo and its server import.
add metaworld==3.1.1 mujoco==3.3.0 packaging PyOpenGL scipy msgspec jaxtyping websockets \
  'tyro>=1.0' docstring_parser fast-simplification trimesh zstandard rich 'imageio[ffmpeg]' \
  matplotlib
add --no-deps --editable "$root" --editable ../lerobot_env_madviz
echo "integrations/lerobot/.venv is ready"
