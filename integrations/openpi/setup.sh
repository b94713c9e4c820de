#!/usr/bin/env bash
# integrations/openpi/setup.sh: an environment for openpi's client, which wants NumPy 1, in
# integrations/openpi/.venv.
set -euo pipefail
"$(dirname "$0")/../client_environment.sh" openpi openpi-client==0.1.2
