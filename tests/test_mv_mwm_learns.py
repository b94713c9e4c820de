"""The recipe mv-mwm learns, which takes its time."""

from pathlib import Path

import pytest

from madviz.measure.evaluate import evaluate
from madviz.training.config import TrainConfig
from madviz.training.train import train
from madviz.world_model.mv_mwm_options import MvMwmConfig


@pytest.mark.slow
def test_mv_mwm_learns_toy_reach(tmp_path: Path) -> None:
    """Nearly an hour on two cores."""
    config = MvMwmConfig(
        steps=13_000, discount=0.9, update_ratio=0.5, entropy_weight=3e-3, eval_episodes=0
    )
    folder = train(
        TrainConfig("toy/reach", "mv-mwm", "mv-mwm", out=tmp_path / "run", mv_mwm=config)
    )
    row = evaluate(str(folder), ["all"], episodes=50).rows["all"]
    assert row["success"] >= 0.7, row
