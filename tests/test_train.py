"""``train``: names that are checked first, a folder that is a policy, a recipe that learns."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from madviz.checkpoint import load_policy
from madviz.evaluate import evaluate
from madviz.light import LightConfig
from madviz.run import Event
from madviz.train import TrainConfig, command, train
from madviz.types import UserError

TINY = LightConfig(
    rounds=2, demonstrations=2, episodes_per_round=4, updates_per_round=3, critic_updates=2
)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"task": "metaworld/hamer"}, "metaworld/hammer"),
        ({"method": "sad"}, "merged-only"),
        ({"recipe": "heavy"}, "light"),
        ({"setting": "seven"}, "three-rgbd"),
        ({"render_profile": "shiny"}, "fast"),
    ],
)
def test_a_name_that_is_unknown_costs_nothing(
    change: dict[str, str], expected: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=expected):
        train(TrainConfig(out=tmp_path / "run", **change))  # type: ignore[arg-type]
    assert not (tmp_path / "run").exists()


def test_names_follow_the_scheme() -> None:
    assert TrainConfig().policy_name() == "metaworld-hammer-mad-light"
    rgbd = TrainConfig(setting="three-rgbd")
    assert rgbd.policy_name() == "metaworld-hammer-mad-three-rgbd-light"


def test_the_command_on_the_card_says_what_was_not_default() -> None:
    config = TrainConfig(task="toy/reach", light=LightConfig(rounds=3, alpha=0.8))
    words = command(config)
    assert words.startswith("madviz train --task toy/reach --method mad --recipe light")
    assert "--light.rounds 3" in words and "--light.alpha 0.8" in words
    assert "batch-size" not in words


def test_a_run_is_a_policy_that_loads_and_a_curve(tmp_path: Path) -> None:
    events: list[Event] = []
    folder = train(
        TrainConfig(task="toy/reach", setting="three-rgbd", out=tmp_path / "run", light=TINY),
        events.append,
    )
    policy = load_policy(folder)
    assert policy.spec.streams[1] == "first.depth"
    assert "depth" in policy.spec.trained_subsets
    views = np.zeros((6, 9, 84, 84), np.uint8)
    readout = policy.read(policy.encode(views, np.zeros(6, np.float32)), np.ones((1, 6), bool))
    assert np.isfinite(readout.action).all() and np.isfinite(readout.q).all()
    with (folder / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["round"] for row in rows] == ["1", "2"]
    assert [event["kind"] for event in events] == ["curve", "curve", "done"]
    assert events[0]["seconds_left"] > 0


@pytest.mark.slow
def test_the_light_recipe_learns_toy_reach_from_any_camera(tmp_path: Path) -> None:
    light = LightConfig(rounds=8, updates_per_round=100, hidden_dim=128, critic_updates=100)
    folder = train(TrainConfig(task="toy/reach", out=tmp_path / "run", light=light))
    rows = evaluate(str(folder), ["all", "first", "third_a", "third_b"], episodes=30).rows
    assert rows["all"]["success"] >= 0.9, rows
    singles = [rows[name]["success"] for name in ("first", "third_a", "third_b")]
    assert np.mean(singles) >= 0.7, rows
