"""tools/recorded_actions.py and the resuming of tools/designs.py: an unfinished set goes on."""

from __future__ import annotations

import importlib
import shutil
from contextlib import closing
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from madviz.envs.registry import make_env
from madviz.policies.config import read_config
from madviz.policies.seeds import training_seed
from madviz.runs.demonstrations import Driver, Episode, record_episode
from madviz.training.kept_episodes import episode_files

ROOT = Path(__file__).parent.parent
CONFIG = ROOT / "checkpoints" / "toy-reach-mv-mwm-mv-mwm" / "config.json"
FILES = ("000-00", "000-01", "001-00")


@pytest.fixture
def tools(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("recorded_actions")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run of training seed 2 that kept three episodes of toy/reach."""
    folder = tmp_path / "run"
    (folder / "episodes").mkdir(parents=True)
    shutil.copy(CONFIG, folder)
    config, _ = read_config(CONFIG)
    with closing(make_env(config.task, config.render_profile, config.cameras)) as env:
        for number, name in enumerate(FILES):
            seed = training_seed(2, number)
            episode = record_episode(env, config.streams, Driver(0.8, 0.5), seed)
            episode.save(folder / "episodes" / f"{name}.npz")
    return folder


def test_episodes_are_the_same_when_they_are_played_again(
    tools: ModuleType, run: Path, tmp_path: Path
) -> None:
    tools.keep(run, tmp_path / "actions")
    tools.play_again(tmp_path / "actions", tmp_path / "again", 2)
    for name in FILES:
        first, second = (
            Episode.load(folder / "episodes" / f"{name}.npz")
            for folder in (run, tmp_path / "again")
        )
        assert first.success == second.success
        for column, rows in first.rows().items():
            assert np.array_equal(rows, second.rows()[column]), column


def test_episodes_of_another_seed_are_refused(tools: ModuleType, run: Path, tmp_path: Path) -> None:
    tools.keep(run, tmp_path / "actions")
    with pytest.raises(ValueError, match="episode 0 of .*: a reward differs by"):
        tools.play_again(tmp_path / "actions", tmp_path / "again", 3)
    assert not (tmp_path / "again" / "config.json").exists(), "it does not pass for complete"


def test_another_machine_goes_on_with_the_same_episodes(
    tools: ModuleType, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    designs = importlib.import_module("designs")
    trained: list[tuple[str, bool]] = []

    def train(out: Path, task: str, seed: int, loss: object, options: list[str]) -> None:
        if len(trained) == 3:
            raise InterruptedError
        trained.append((out.name, "--light.episodes" in options))
        if "--light.keep-episodes" in options:
            shutil.copytree(run, out)
            return
        recorded = Path(options[options.index("--light.episodes") + 1])
        assert len(episode_files(recorded / "episodes")) == 2

    monkeypatch.setattr(designs, "ROOT", tmp_path)
    monkeypatch.setattr(designs, "_train", train)
    monkeypatch.setattr(
        designs,
        "_evaluated",
        lambda policy, place, loss, count: [designs.Row(*place, *loss, "all", 30_000, "1", "1")],
    )
    (tmp_path / "results").mkdir()
    with pytest.raises(InterruptedError):
        designs.main(["crossed", str(tmp_path / "here"), "toy/reach", "2"])
    actions = tmp_path / "results" / "crossed" / "toy-reach-turns-seed2"
    assert trained == [("mad-0.25", False), ("mad-0.8", True), ("merged-only-0.25", True)]
    assert actions.exists()
    trained[:] = [("", True)] * 4  # Never three: nothing stops it now.
    designs.main(["crossed", str(tmp_path / "there"), "toy/reach", "2"])
    turns, other = trained[4:8], trained[8:]
    names = ["singular-only-0.25", *(f"single-0.25-{camera}" for camera in designs.CAMERAS)]
    assert turns == [(name, True) for name in names], "what was evaluated is not trained again"
    assert [name for name, _ in other] == ["mad-0.25", "mad-0.8", "merged-only-0.25", names[0]]
    assert not actions.exists() and not (tmp_path / "there" / actions.name).exists()
