#!/usr/bin/env bash
# integrations/vla_eval/setup.sh: an environment for vla-eval's harness with madviz's tasks in it, in
# integrations/vla_eval/.venv. This much is enough for the toy; for tasks on MuJoCo add
# metaworld==3.1.1 mujoco==3.3.0 packaging PyOpenGL fast-simplification trimesh.
set -euo pipefail
"$(dirname "$0")/../client_environment.sh" vla_eval vla-eval==0.8.0
