"""What every test needs: MuJoCo draws without a display, and no test waits for a thread pool."""

from __future__ import annotations

import os
from collections.abc import Iterator

# Set before anything imports NumPy or torch, which read them only then. Tests run side by side, and
# their networks are too small to share out: waiting for the other core costs more.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from jaxtyping import install_import_hook

from tests.shapes import MODULES

# Before anything imports them.
install_import_hook(MODULES, "tests.shapes.checked")

# Set before anything imports MuJoCo, which reads it only then; the command line does the same.
os.environ.setdefault("MUJOCO_GL", "egl")


@pytest.fixture(autouse=True)
def _seeded() -> Iterator[None]:
    """Networks that a test makes are the same whichever tests ran before it. A training chooses its
    own number of threads; it is one again when the next test begins, or the next module."""
    import torch

    torch.manual_seed(0)
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(1)


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
