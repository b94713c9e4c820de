"""The paper recipe, whole and small: does reinforcement learning alone solve the toy?"""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from madviz.recipes.paper import PaperConfig
from madviz.train import TrainConfig, train

CONFIG = PaperConfig(
    steps=3_000,
    exploration_steps=500,
    batch_size=48,
    buffer_capacity=3_000,
    hidden_dim=128,
    discount=0.9,
    learning_rate=1e-3,
    eval_every=3_000,
    eval_episodes=20,
)
"""1,250 updates, about 2 minutes of one core: all 1.0, singles 1.0, 0.9 and 0.7 (10 episodes each).
The paper's rate, width and batch need hours."""


@pytest.mark.slow
def test_mad_learns_toy_reach_from_rewards_alone(tmp_path: Path) -> None:
    folder = train(TrainConfig("toy/reach", recipe="paper", out=tmp_path, paper=CONFIG))
    with (folder / "curve.csv").open() as file:
        rows = [
            {name: float(value) for name, value in row.items() if name.startswith("success")}
            for row in csv.DictReader(file)
        ]
    singles = [name for name in rows[0] if name != "success_all"]
    assert rows[0]["success_all"] <= 0.2, "an untrained policy does not reach the target"
    assert rows[-1]["success_all"] >= 0.7
    assert sum(rows[-1][name] for name in singles) / len(singles) >= 0.5
