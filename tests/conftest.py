"""What every test needs: MuJoCo draws without a display, and no test waits for a thread pool."""

from __future__ import annotations

import os

# Set before anything imports MuJoCo, which reads it only then; the command line does the same.
os.environ.setdefault("MUJOCO_GL", "egl")
