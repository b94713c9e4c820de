"""What every test needs: MuJoCo draws without a display, and no test waits for a thread pool."""

from __future__ import annotations

import os

import pytest
from jaxtyping import install_import_hook

from tests.shapes import MODULES

# Before anything imports them.
install_import_hook(MODULES, "tests.shapes.checked")

# Set before anything imports MuJoCo, which reads it only then; the command line does the same.
os.environ.setdefault("MUJOCO_GL", "egl")


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """Networks that a test makes are the same whichever tests ran before it."""
    import torch

    torch.manual_seed(0)


@pytest.fixture
def session():
    """A session whose frames are kept, at its first step."""
    from tests.sessions import Recorder

    recorder = Recorder()
    recorder.at(0.0)
    return recorder


@pytest.fixture(scope="module")
def server():
    """A page's server without visitors, for panels that need no browser."""
    import viser

    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()
