"""Trainings that end, or are stopped, and the state they leave."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest
import torch

from madviz.errors import Interrupted
from madviz.runs.run_folder import RunFolder
from madviz.training.config import TrainConfig
from madviz.training.train import train


def last_state(config: TrainConfig, listener: Any = None) -> dict[str, Any]:
    """Trains as ``madviz train`` does; the last state, which stays to be compared. The number of
    PyTorch's threads is afterwards what it was."""
    assert config.out is not None
    threads = torch.get_num_threads()
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(RunFolder, "finish", lambda self: None)
            with suppress(Interrupted):
                train(config, listener or (lambda event: None))
    finally:
        torch.set_num_threads(threads)
    return torch.load(config.out / "resume" / "state.pt", weights_only=True)
