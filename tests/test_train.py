"""``train``: names that are checked first, a folder that is a policy, a recipe that learns."""

from __future__ import annotations

import csv
import os
import shlex
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from madviz import cli
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.measure.evaluate import evaluate
from madviz.policies.checkpoint import load_policy
from madviz.runs.run_folder import Event, changes
from madviz.runs.training_plan import TrainingPlan
from madviz.training.config import RECIPES, TrainConfig, command, resolve
from madviz.training.light import LightConfig
from madviz.training.train import train
from tests.plans import record_inline
from tests.recipe_runs import facts_of

TINY = LightConfig(
    rounds=2, demonstrations=2, episodes_per_round=4, updates_per_round=3, batch_size=4,
    critic_updates=2, hidden_dim=16,
)  # fmt: skip


@pytest.fixture
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    record_inline(monkeypatch)


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
    assert resolve(TrainConfig()).spec.name == "metaworld-hammer-mad-light"
    rgbd = TrainConfig(setting="three-rgbd")
    assert resolve(rgbd).spec.name == "metaworld-hammer-mad-three-rgbd-light"


def test_a_state_without_where_the_cube_began_is_read_in_part_and_stands_in_the_command() -> None:
    plan = resolve(TrainConfig("maniskill/pull-cube", state="no-start"))
    assert plan.networks.state_columns == tuple(range(25)) and plan.networks.state_dim == 28
    assert "--state no-start" in plan.command


def test_the_command_on_the_card_says_what_was_not_default() -> None:
    config = TrainConfig(task="toy/reach", light=LightConfig(rounds=3, alpha=0.8))
    words = command(config)
    assert words.startswith("madviz train --task toy/reach --method mad --recipe light")
    assert "--light.rounds 3" in words and "--light.alpha 0.8" in words
    assert "batch-size" not in words


def test_a_critic_that_learned_nothing_has_no_q(tmp_path: Path, inline: None) -> None:
    light = replace(TINY, critic_updates=0)
    policy = load_policy(train(TrainConfig("toy/reach", out=tmp_path / "run", light=light)))
    views = np.zeros((3, 9, 84, 84), np.uint8)
    readout = policy.read(policy.encode(views, np.zeros(6, np.float32)), np.ones((1, 3), bool))
    assert np.isfinite(readout.action).all() and np.isnan(readout.q).all()


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


CAMERAS = """
[[camera]]
name = "first"
position = [0, 0, 1.0]
wxyz = [1, 0, 0, 0]
fovy = 60
body = "hand"
label = "First person"
size = {size}

[[camera]]
name = "third_b"
position = [0, 0, 2.0]
wxyz = [1, 0, 0, 0]
fovy = 60
label = "Third B"
"""


@pytest.mark.usefixtures("inline")
def test_a_finished_run_keeps_the_policy_alone_and_has_nothing_left_to_do(tmp_path: Path) -> None:
    config = TrainConfig("toy/reach", out=tmp_path, light=replace(TINY, rounds=1))
    train(config, lambda event: None)
    assert {file.name for file in (tmp_path / "resume").iterdir()} == {"run.json", "finished"}
    with pytest.raises(UserError, match="holds a finished run; choose another --out"):
        train(config, lambda event: None)
    weights = (tmp_path / "weights.safetensors").read_bytes()
    (tmp_path / "resume" / "state.pt").touch()  # As if it had been killed while it tidied up.
    events: list[Event] = []
    train(replace(config, resume=True), events.append)
    assert [event["kind"] for event in events] == ["done"]
    assert not (tmp_path / "resume" / "state.pt").exists()
    assert (tmp_path / "weights.safetensors").read_bytes() == weights


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_training_says_how_to_go_on(number: int, code: int, tmp_path: Path) -> None:
    words = ["train", "--task", "toy/reach", "--out", str(tmp_path / "a run")]
    words += ["--light.rounds", "40", "--light.demonstrations", "2", "--light.critic-updates", "2"]
    words += ["--light.episodes-per-round", "2", "--light.updates-per-round", "3"]
    words += ["--light.batch-size", "4", "--light.hidden-dim", "16"]
    with subprocess.Popen(
        [sys.executable, "-m", "madviz", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as training:
        assert training.stderr is not None
        assert training.stderr.readline().startswith("[curve]")
        os.killpg(training.pid, number)  # To its workers, too, as a terminal or a service does.
        printed, said = training.communicate()
    assert training.returncode == code and printed == "" and "[done]" not in said
    last = said.splitlines()[-1]
    assert last.startswith("madviz: stopped; resume with: madviz train --task toy/reach")
    assert last.endswith(f"--out '{tmp_path}/a run' --resume")
    again = TrainConfig("toy/reach", out=tmp_path / "a run", resume=True)
    goes_on = shlex.split(last.partition("resume with: ")[2])
    assert cli.parse("train", goes_on[2:]) == replace(
        again,
        light=LightConfig(40, 2, 2, 3, batch_size=4, critic_updates=2, hidden_dim=16),
    )


@pytest.mark.usefixtures("inline")
@pytest.mark.parametrize("resume", [False, True])
def test_two_trainings_do_not_share_a_folder(resume: bool, tmp_path: Path) -> None:
    config = TrainConfig("toy/reach", out=tmp_path / "run", light=TINY)
    refused: list[str] = []

    def second(event: Event) -> None:
        with pytest.raises(UserError, match="another process trains in") as caught:
            train(replace(config, resume=resume), lambda event: None)
        refused.append(str(caught.value))

    train(config, second)
    assert len(refused) == 3 and "choose another --out" in refused[0]
    train(replace(config, resume=True), lambda event: None)  # Free again.
    assert not (tmp_path / "run" / "resume" / "lock").exists()


def test_a_refused_run_leaves_nothing(tmp_path: Path) -> None:
    config = TrainConfig("toy/reach", out=tmp_path / "run", light=TINY)
    with pytest.raises(UserError, match="nothing to resume"):
        train(replace(config, resume=True), lambda event: None)
    assert not any(tmp_path.iterdir())


@pytest.mark.usefixtures("inline")
def test_a_resumed_run_has_the_same_cameras_wherever_their_file_is(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(CAMERAS.format(size=84))
    light = replace(TINY, rounds=1)
    config = TrainConfig("toy/reach", cameras=file, out=tmp_path / "run", light=light)
    train(config, lambda event: None)
    weights = (tmp_path / "run" / "weights.safetensors").read_bytes()

    file.write_text(CAMERAS.format(size=64))
    again = replace(config, resume=True)
    with pytest.raises(UserError, match=r"another configuration: cameras 1.size 84 -> 64;"):
        train(again, lambda event: None)
    with pytest.raises(UserError, match=r"cameras \[first, third_b\] -> None"):
        train(replace(again, cameras=None), lambda event: None)

    moved = tmp_path / "elsewhere" / "mine.toml"
    moved.parent.mkdir()
    file.write_text(CAMERAS.format(size=84) + "\n# The same cameras, and a comment.\n")
    file.rename(moved)
    train(replace(again, cameras=moved), lambda event: None)
    assert (tmp_path / "run" / "weights.safetensors").read_bytes() == weights


def test_changes_are_named_one_by_one() -> None:
    before = {"seed": 1, "paper": {"alpha": 0.8, "steps": 5}, "gone": 1, "cameras": None}
    now = {"seed": 1, "paper": {"alpha": 0.5, "steps": 5, "new": 3}, "cameras": [{"name": "a"}]}
    assert changes(before, now) == ["paper.alpha 0.8 -> 0.5", "cameras None -> [a]"]


def test_a_run_that_broke_before_it_began_stands_in_nobodys_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(self: TrainingPlan) -> None:
        raise RuntimeError("a mistake of ours")

    with monkeypatch.context() as patch, pytest.raises(RuntimeError):
        patch.setattr(TrainingPlan, "new_agent", broken)
        train(TrainConfig("toy/reach", out=tmp_path / "run", light=TINY))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"light": replace(TINY, shift=84)}, "--light.shift: .* from 0 to 83, found 84"),
        (
            {"state": "paper", "light": TINY},
            "a task with fewer numbers .* toy/reach, which has none; leave",
        ),
        (
            {"state": "no-start", "light": TINY},
            "whose state tells where the object began .* found toy/reach; leave",
        ),
    ],
)
def test_options_that_cannot_be_carried_out_cost_nothing(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=message):
        train(replace(TrainConfig("toy/reach", out=tmp_path / "run"), **change))
    assert not (tmp_path / "run").exists()


def test_what_changes_only_time_or_room_may_change() -> None:
    config = TrainConfig("toy/reach", recipe="paper-vectorised", threads=1)
    other = replace(
        config,
        light=TINY,
        vectorised=replace(
            config.vectorised, workers=7, save_every=9, buffer_packed=False, buffer_on_disk=True
        ),
        out=Path("elsewhere"),
        resume=True,
    )
    assert facts_of(config) == facts_of(other)
    slower = replace(config, vectorised=replace(config.vectorised, update_ratio=0.25))
    assert changes(facts_of(config), facts_of(slower)) == ["vectorised.update_ratio 0.5 -> 0.25"]


def test_the_threads_of_the_learner_may_not_change(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8))
    light = TrainConfig("toy/reach")
    assert facts_of(light) == facts_of(replace(light, light=LightConfig(workers=3)))
    assert facts_of(light) == facts_of(replace(light, threads=1)), "what it takes anyway"
    lanes = TrainConfig("toy/reach", recipe="paper-vectorised")
    fewer = replace(lanes, vectorised=replace(lanes.vectorised, workers=2))
    assert changes(facts_of(lanes), facts_of(fewer)) == ["threads_used 7 -> 6"]
    older = {name: each for name, each in facts_of(lanes).items() if name != "threads_used"}
    assert changes({**older, "threads": None}, facts_of(fewer)) == []


OWN: dict[str, Any] = {}


def make_own() -> ToyReach:
    env = ToyReach()
    env.spec = replace(env.spec, **OWN)
    return env


def test_an_own_task_that_has_changed_is_another_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MADVIZ_TASKS", "")
    config = TrainConfig("tests.test_train:make_own", light=TINY)
    before = facts_of(config)
    monkeypatch.setitem(OWN, "horizon", 30)
    assert changes(before, facts_of(config)) == ["own_task.horizon 25 -> 30"]
    assert {camera["name"] for camera in before["own_task"]["cameras"]} == set(
        SETTINGS["three"].streams
    )


@pytest.mark.parametrize(
    "error", [ConnectionRefusedError(111, "refused"), FileNotFoundError(2, "gone", "a.npz")]
)
def test_an_error_of_a_task_is_no_lack_of_room(
    error: OSError, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: Any) -> None:
        raise error

    monkeypatch.setitem(RECIPES, "light", replace(RECIPES["light"], train=fails))
    with pytest.raises(type(error)):
        train(TrainConfig("toy/reach", out=tmp_path / "run", light=TINY))


@pytest.mark.parametrize(
    ("drivers", "change"), [("all", {"focus": 0.5}), ("expert", {"share_decay": 0.9})]
)
def test_options_that_a_driver_leaves_without_effect_are_refused(
    tmp_path: Path, drivers: str, change: dict[str, float]
) -> None:
    light = replace(TINY, drivers=drivers, **change)
    with pytest.raises(UserError, match=f"light.drivers '{drivers}' without {next(iter(change))}"):
        train(TrainConfig("toy/reach", out=tmp_path / "run", light=light))


def test_cameras_of_a_setting_and_of_a_file_are_refused_together(tmp_path: Path) -> None:
    config = TrainConfig("metaworld/hammer", setting="five", cameras=tmp_path / "mine.toml")
    with pytest.raises(UserError, match="cameras of its own, found 'five'; leave one of them out"):
        resolve(config)


def test_the_learner_takes_the_cores_that_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8))
    config = TrainConfig()
    assert config.light.threads() == 1  # The recorder has another core.
    assert config.paper.threads() == 8
    assert replace(config.vectorised, workers=3).threads() == 5
    assert replace(config.mv_mwm, workers=9).threads() == 1
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(2))
    assert config.vectorised.processes() == 1 and config.vectorised.threads() == 2


@pytest.mark.parametrize(
    ("cores", "on_cuda", "workers", "threads"),
    [(4, False, 1, 3), (8, False, 1, 7), (32, False, 4, 28), (16, True, 8, 8), (4, True, 3, 1)],
)
def test_workers_are_few_beside_a_cpu_that_learns_and_many_beside_a_gpu(
    monkeypatch: pytest.MonkeyPatch, cores: int, on_cuda: bool, workers: int, threads: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(cores))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: on_cuda)
    for lanes in (TrainConfig().vectorised, TrainConfig().mv_mwm):
        assert lanes.environments == 8
        assert (lanes.processes(), lanes.threads()) == (workers, threads)


@pytest.mark.slow
def test_the_light_recipe_learns_toy_reach_from_any_camera(tmp_path: Path) -> None:
    light = LightConfig(rounds=8, updates_per_round=100, hidden_dim=128, critic_updates=100)
    folder = train(TrainConfig(task="toy/reach", out=tmp_path / "run", light=light))
    rows = evaluate(str(folder), ["all", "first", "third_a", "third_b"], episodes=30).rows
    assert rows["all"]["success"] >= 0.9, rows
    singles = [rows[name]["success"] for name in ("first", "third_a", "third_b")]
    assert np.mean(singles) >= 0.7, rows


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("--recipe", "paper-vectorised", "--paper.alpha", "0.5"), "--paper.alpha"),
        (("--paper.steps=5000",), "--paper.steps"),
        (("--recipe=paper", "--light.keep-episodes"), "--light.keep-episodes"),
    ],
)
def test_an_option_of_another_recipe_is_refused(words: tuple[str, ...], option: str) -> None:
    with pytest.raises(UserError, match=f"expected {option} with --recipe .*no use for it"):
        cli.parse("train", ["--task", "toy/reach", *words])
