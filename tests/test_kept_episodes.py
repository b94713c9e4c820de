"""A run that learns from another run's episodes, and a run that says who drives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from madviz.errors import UserError
from madviz.policies.checkpoint import load_policy
from madviz.policies.config import read_config
from madviz.runs.demonstrations import Recorder
from madviz.training.config import TrainConfig
from madviz.training.light import LightRun
from madviz.training.light_options import LightConfig
from madviz.training.train import train
from tests.plans import record_inline, toy_plan

TINY = LightConfig(
    rounds=3, demonstrations=2, episodes_per_round=2, updates_per_round=3, batch_size=4,
    hidden_dim=32, critic_updates=0, keep_episodes=True,
)  # fmt: skip
READS = replace(TINY, keep_episodes=False)


def trained(out: Path, light: LightConfig, **options: Any) -> Path:
    config = TrainConfig(out=out, threads=1, light=light, **{"task": "toy/reach", **options})
    return train(config, lambda event: None)


@pytest.fixture(autouse=True)
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    record_inline(monkeypatch)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that kept its episodes; nobody changes it."""
    with pytest.MonkeyPatch.context() as patch:
        record_inline(patch)
        return trained(tmp_path_factory.mktemp("kept") / "recorded", TINY)


def test_episodes_stay_only_where_they_are_asked_for(recorded: Path, tmp_path: Path) -> None:
    names = sorted(file.name for file in (recorded / "episodes").iterdir())
    assert names == [f"{index:03d}-{number:02d}.npz" for index in range(3) for number in range(2)]
    assert not list(trained(tmp_path / "plain", READS).rglob("*.npz"))


def test_learning_from_kept_episodes_gives_the_same_weights(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nothing_to_record(self: Any, plan: list) -> list:
        assert not plan
        return []

    monkeypatch.setattr(Recorder, "start", nothing_to_record)
    again = trained(tmp_path / "again", replace(READS, episodes=str(recorded)))
    assert (again / "weights.safetensors").read_bytes() == (
        recorded / "weights.safetensors"
    ).read_bytes()
    assert "--light.episodes" in (read_config(again / "config.json")[0].training.command or "")


def test_a_policy_of_one_camera_reads_its_own_pictures(recorded: Path, tmp_path: Path) -> None:
    light = replace(READS, episodes=str(recorded))
    single = trained(tmp_path / "single", light, method="single", camera="third_b")
    assert load_policy(single).spec.streams == ("third_b",)


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        ({"noise_share": 0.1}, {}, "found noise_share"),
        ({"drivers": "all"}, {}, "found drivers"),
        ({"rounds": 4}, {}, "expected 4 rounds of 8 episodes in .*, found 3 of 6"),
        ({}, {"setting": "three-rgbd"}, "in the episodes of .*, found first, third_a"),
        ({}, {"task": "metaworld/push"}, "trained with task = toy/reach"),
    ],
)
def test_episodes_that_do_not_fit_are_refused(
    change: dict, options: dict, words: str, recorded: Path, tmp_path: Path
) -> None:
    light = replace(READS, episodes=str(recorded), **change)
    with pytest.raises(UserError, match=words):
        trained(tmp_path / "refused", light, **options)
    assert not (tmp_path / "refused" / "config.json").exists()


def test_a_folder_without_episodes_names_the_option_that_keeps_them(tmp_path: Path) -> None:
    light = replace(READS, episodes=str(tmp_path / "none"))
    with pytest.raises(UserError, match="--light.keep-episodes"):
        trained(tmp_path / "refused", light)


@pytest.mark.parametrize(
    ("drivers", "masks"),
    [
        ("all", {(1, 1, 1)}),
        ("turns", {(1, 1, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1)}),
        ("expert", {None}),
    ],
)
def test_the_driver_is_the_one_that_was_asked_for(drivers: Any, masks: set, tmp_path: Path) -> None:
    config = replace(TINY, drivers=drivers, episodes_per_round=4)
    planned = LightRun(toy_plan(), config, tmp_path).drivers(1)
    assert {None if d.mask is None else tuple(d.mask) for d, _ in planned} == masks
    assert all((d.expert_share == 1.0) == (drivers == "expert") for d, _ in planned)
    assert [seed for _, seed in planned] == [2, 3, 4, 5]
