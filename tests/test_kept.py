"""Kept sessions: what a journal writes is lived again to the bit, and files are not believed."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from madviz import cli
from madviz.ablations import Ablation, CameraState, Occlusion, OcclusionKind
from madviz.envs.base import make_env
from madviz.replay import failures_of, live_again, replay_row, replay_words
from madviz.session.commands import (
    Fork,
    Pause,
    Play,
    Reset,
    Scrub,
    SetCamera,
    SetPolicy,
    SetSchedule,
    SetSeed,
)
from madviz.session.failures import parse_schedule
from madviz.session.frame import Frame
from madviz.session.kept import KeptEpisode, KeptPolicy, KeptSession
from madviz.session.kept_reader import LONGEST, parse, read_kept
from madviz.session.session import Session
from madviz.session.simulation import Simulation
from madviz.types import CameraSpec, Policy, UserError, View
from tests.fakes import FakePolicy, policies

CAMERAS = ("first", "third_a", "third_b")
NAMES = ("toy-mad", "toy-rgbd", "toy-other")
KINDS = get_args(OcclusionKind)
OFF = CameraState("off")
HAMMER = "metaworld-hammer-mad-light"


def find(policy: KeptPolicy) -> Policy:
    return policies(policy.name)


class Interrupted:
    """A toy world in which things are sent while a camera is being drawn."""

    def __init__(self, *world: Any) -> None:
        self._env = make_env(*world)
        self.meanwhile: Any = lambda: None

    def view(self, camera: str, size: int | None = None) -> View:
        self.meanwhile()
        return self._env.view(camera, size)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)


def session_with(world: list[Interrupted], **options: Any) -> Session:
    def build(task: str, profile: str, cameras: tuple[CameraSpec, ...]) -> Any:
        world.append(Interrupted(task, profile, cameras))
        return world[-1]

    session = Session(build, FakePolicy(), policies, speed=None, **options)
    session.tick(0.0)
    return session


def random_camera(rng: np.random.Generator) -> SetCamera:
    width, height = rng.random(2).tolist()
    kind = str(rng.choice(KINDS))
    occlusion = Occlusion(kind, float(rng.random()), width=width, height=height)  # type: ignore[arg-type]
    state = CameraState(str(rng.choice(["rgb", "depth", "both", "off", "both"])), occlusion)  # type: ignore[arg-type]
    return SetCamera(str(rng.choice(CAMERAS)), state)


def random_command(rng: np.random.Generator, step: int) -> Any:
    draw = rng.random()
    if draw < 0.72:
        return random_camera(rng)
    if draw < 0.86:
        return SetPolicy(str(rng.choice(NAMES)))
    if draw < 0.92:
        words = ["third_a@3-9", "first=noise:0.5@5", "third_b=freeze@2-20"]
        return SetSchedule(parse_schedule(words[: rng.integers(4)], CAMERAS))
    if draw < 0.96 and step > 1:
        return Scrub(int(rng.integers(step)))
    return Fork() if draw < 0.98 else Reset(next_seed=bool(rng.integers(2)))


def lived(seed: int, steps: int) -> KeptSession:
    """A session with a wild visitor, who also clicks while pictures are drawn."""
    rng, world = np.random.default_rng(seed), []
    session = session_with(world, seed=seed)

    def meanwhile() -> None:
        if rng.random() < 0.15:
            session.send(random_camera(rng))

    for tick in range(steps):
        world[-1].meanwhile = meanwhile
        step = getattr(session.latest, "step", 0)
        for _ in range(int(rng.integers(3))):
            session.send(random_command(rng, step))
        session.send(Play())
        session.tick(float(tick))
    return session.keep()


def same(one: KeptEpisode, other: KeptEpisode) -> bool:
    return (one.sha256, one.trace, one.success, one.ended, one.steps) == (
        *(other.sha256, other.trace, other.success, other.ended),
        other.steps,
    )


@pytest.mark.parametrize("seed", range(10))
def test_whatever_a_visitor_did_is_lived_again_to_the_bit(seed: int) -> None:
    kept = lived(seed, 50)
    read = parse(kept.to_json().encode(), "here")
    assert read == kept and sum(episode.steps for episode in read.episodes) >= 20
    for episode in read.episodes:
        assert same(live_again(episode, find), episode)


def test_commands_matter_and_so_do_their_steps() -> None:
    """Or the test above would pass with a journal that forgets."""
    episode = max(lived(0, 50).episodes, key=lambda one: len(one.commands))
    missed = 0
    for index in range(0, len(episode.commands), 3):
        fields = {**vars(episode)}
        fields["commands"] = episode.commands[:index] + episode.commands[index + 1 :]
        missed += not same(live_again(KeptEpisode(**fields), find), episode)
    assert missed >= 2


def test_previews_leave_no_trace_however_many_there_are() -> None:
    """Two in one step once left the first one in the stack."""
    world: list[Interrupted] = []
    session = session_with(world, seed=5)
    states = [CameraState("rgb", Occlusion(kind)) for kind in ("black", "blur", "none")]  # type: ignore[arg-type]
    sent = iter(states)

    def meanwhile() -> None:
        state = next(sent, None)
        if state is not None:
            session.send(SetCamera("third_a", state))

    world[0].meanwhile = meanwhile
    for tick in range(8):
        session.tick(float(tick))
    plain = Simulation(make_env("toy/reach"), FakePolicy(), Ablation())
    plain.begin(5)
    for _ in range(9):
        plain.step(lambda: None)
    assert session.keep().episodes[-1].sha256 == plain.journal.kept().episodes[-1].sha256


def test_a_dragged_slider_leaves_one_line() -> None:
    session = session_with([], seed=3)
    session.send(Pause())
    for strength in np.linspace(0, 1, 50):
        session.send(SetCamera("first", CameraState("rgb", Occlusion("noise", float(strength)))))
    session.send(Play())
    session.tick(1.0)
    (episode,) = session.keep().episodes
    assert [one.command for one in episode.commands] == [
        SetCamera("first", CameraState("rgb", Occlusion("noise", 1.0)))
    ]


def test_settings_that_outlive_an_episode_are_in_the_next_ones_start() -> None:
    session = session_with([], seed=3)
    for command in (SetCamera("third_b", OFF), SetSeed(9)):
        session.send(command)
        session.tick(0.0)
    session.tick(1.0)
    episode = session.keep().episodes[-1]
    assert (episode.seed, episode.commands) == (9, ())
    assert episode.start == (SetCamera("third_b", OFF),)
    assert same(live_again(episode, find), episode)


def test_the_journal_forgets_the_oldest_and_keeps_no_broken_episode() -> None:
    session = session_with([], seed=0)
    for tick in range(30):
        session.send(SetSeed(tick))
        session.tick(float(tick))
    kept = session.keep()
    assert [episode.seed for episode in kept.episodes] == list(range(9, 30))
    assert [episode.seed for episode in kept.last().episodes] == [29]

    broken = session_with(world := [], seed=0)

    def fail() -> None:
        raise RuntimeError("no picture")

    broken.tick(1.0)
    world[0].meanwhile = fail
    broken.tick(2.0)
    world[0].meanwhile = lambda: None
    broken.send(Play())
    broken.tick(3.0)
    with pytest.raises(UserError, match="let it run first"):
        broken.keep()


def test_a_session_follows_a_kept_episode_then_is_the_visitors() -> None:
    original = lived(4, 60).episodes[0]
    first = policies(original.policy.name)
    session = Session(make_env, first, policies, speed=None, script=original)
    session.tick(0.0)
    assert session.tick(9.0) is None and isinstance(session.latest, Frame)
    assert (session.latest.step, session.latest.phase) == (0, "paused")  # Nobody watches yet.
    session.send(Play())
    for tick in range(original.steps + 1):
        session.tick(float(tick))
    again = session.keep().episodes[0]
    assert again.trace[: len(original.trace)] == original.trace
    session.send(SetSeed(77))
    session.tick(99.0)
    session.tick(100.0)
    assert not session.keep().episodes[-1].commands


def test_a_difference_is_found_and_explained() -> None:
    kept = lived(1, 40)
    episode = kept.episodes[0]
    fields = {**vars(episode), "policy": KeptPolicy("toy-mad", "older")}
    fields["trace"] = episode.trace[:8] + "0000" + episode.trace[12:]
    fields["sha256"] = {**episode.sha256, "actions": "0" * 64}
    other = KeptSession((KeptEpisode(**fields),), {**kept.versions, "numpy": "0.1"})
    row = replay_row(other.episodes[0], other, find)
    assert not row["same"] and row["first_difference"] == 3
    assert row["same_bits"] == {"actions": False, "rewards": True, "success": True}
    words = replay_words({"episodes": [row]})
    assert "actions DIFFER from decision 3 on: toy-mad had the digest older" in words
    assert "numpy was 0.1" in words


def test_failures_of_an_episode_in_words() -> None:
    session = session_with([], seed=0)
    session.send(SetSchedule(parse_schedule(["third_a@2-4", "first=black@3"], CAMERAS)))
    for tick in range(7):
        session.tick(float(tick))
    assert failures_of(session.keep().episodes[0]) == ["third_a@2-4", "first=black@3"]


# --- Files from anybody -----------------------------------------------------------------------


@cache
def document() -> dict[str, Any]:
    return json.loads(lived(2, 20).last().to_json())


def put(document: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A copy with ``value`` at ``a.0.b``."""
    changed = copy.deepcopy(document)
    *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    place: Any = changed
    for parent in parents:
        place = place[parent]
    place[last] = value  # type: ignore[index]
    return changed


@pytest.mark.parametrize(
    ("path", "value"),
    [
        *[("schema", 2), ("schema", True), ("episodes", []), ("episodes", {}), ("surprise", 1)],
        *[("versions", []), ("versions", {"numpy": 2}), ("versions", {"x\n": "1"})],
        *[("episodes.0.seed", -1), ("episodes.0.seed", 2**31), ("episodes.0.seed", 1.0)],
        *[("episodes.0.seed", True), ("episodes.0.steps", 0), ("episodes.0.steps", 10**30)],
        *[("episodes.0.policy.name", name) for name in ("a/b", "os:system", "..", "", "x" * 200)],
        *[("episodes.0.policy.digest", "<b>"), ("episodes.0.policy.extra", "")],
        *[("episodes.0.task", "../../etc"), ("episodes.0.task", 3)],
        *[("episodes.0.render_profile", "best"), ("episodes.0.ended", "yes")],
        *[("episodes.0.cameras", []), ("episodes.0.cameras.0.name", "third_a")],
        *[("episodes.0.cameras.0.fovy", 1e999), ("episodes.0.cameras.0.fovy", 0)],
        *[("episodes.0.cameras.0.position", [0, 0]), ("episodes.0.cameras.0.wxyz", [0, 0, 0, 0])],
        *[("episodes.0.cameras.0.position", [0, 0, 1e9]), ("episodes.0.cameras.0.size", 10**6)],
        *[("episodes.0.cameras.0.depth_range", [2, 1]), ("episodes.0.cameras.0.size", 84.5)],
        *[("episodes.0.cameras.0.body", 5), ("episodes.0.cameras.0.label", "a\u0000")],
        ("episodes.0.start", [{"camera": "fourth", "input": "off"}]),
        ("episodes.0.start", [{"camera": "first", "input": "gone"}]),
        ("episodes.0.start", [{"camera": "first", "input": "off", "step": 0}]),
        ("episodes.0.start", [{"camera": "first", "input": "rgb", "occlusion": {"kind": "rain"}}]),
        ("episodes.0.commands", [{"camera": "first", "input": "off"}]),
        ("episodes.0.commands", [{"step": 9999, "camera": "first", "input": "off"}]),
        ("episodes.0.commands", [{"step": 0, "policy": "a/b", "digest": ""}]),
        ("episodes.0.commands", [{"step": 1, "policy": "a", "digest": "", "camera": "first"}]),
        ("episodes.0.commands", [[]]),
        ("episodes.0.commands", [{"step": s, "policy": "a", "digest": ""} for s in (2, 1)]),
        ("episodes.0.sha256.actions", "0" * 63),
        ("episodes.0.trace", "0"),
    ],
)
def test_a_file_that_will_not_do_is_refused_in_one_line(path: str, value: Any) -> None:
    content = json.dumps(put(document(), path, value)).encode()
    with pytest.raises(UserError) as refused:
        parse(content, "kept.json")
    line = str(refused.value)
    assert line.startswith("kept.json: expected") and "found" in line and ";" in line
    assert "\n" not in line and len(line) < 400


def test_a_file_from_before_patches_had_two_sides_has_squares() -> None:
    patch = {"kind": "patch", "strength": 1.0, "x": 0.2, "y": 0.5, "size": 0.3}
    start = [{"camera": "first", "input": "rgb", "occlusion": patch}]
    read = parse(json.dumps(put(document(), "episodes.0.start", start)).encode(), "old.json")
    square = Occlusion("patch", x=0.2, width=0.3, height=0.3)
    assert read.episodes[0].start == (SetCamera("first", CameraState("rgb", square)),)
    assert parse(read.to_json().encode(), "new.json") == read
    for wrong in ({"width": 0.3}, {"width": 0.3, "height": 2.0}, {"size": "0.3"}):
        without = {key: value for key, value in patch.items() if key != "size"}
        start[0]["occlusion"] = without | wrong
        with pytest.raises(UserError, match="old.json: expected episodes"):
            parse(json.dumps(put(document(), "episodes.0.start", start)).encode(), "old.json")
    start[0]["occlusion"] = patch | {"width": 0.3, "height": 0.3}
    with pytest.raises(UserError, match="an object with kind, strength, x, y, size"):
        parse(json.dumps(put(document(), "episodes.0.start", start)).encode(), "old.json")


def test_files_that_are_no_kept_session_at_all(tmp_path: Path) -> None:
    for content in (b"", b"\xff\xfe", b"[" * 100_000, b"NaN", b"5", b'{"schema": 1, "schema": 1}'):
        with pytest.raises(UserError):
            parse(content, "x")
    long = tmp_path / "long.json"
    long.write_bytes(b" " * (LONGEST + 1))
    for path in (long, tmp_path, tmp_path / "none.json"):
        with pytest.raises(UserError) as refused:
            read_kept(path)
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("episodes.0.ended", True, "expected 25 decisions"),
        ("episodes.0.task", "toy/leap", "unknown task"),
        ("episodes.0.policy.name", "nobody", "unknown policy"),
        ("episodes.0.cameras.0.fovy", 33, "toy/reach has the cameras"),
    ],
)
def test_a_file_that_cannot_be_lived_here_says_why(path: str, value: Any, words: str) -> None:
    kept = parse(json.dumps(put(document(), path, value)).encode(), "x")
    with pytest.raises(UserError, match=words):
        live_again(kept.episodes[0], find)


# --- In another process -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def hammer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten decisions of a bundled policy, with one camera dropped and one occluded."""
    from madviz.checkpoint import load_policy
    from madviz.rollout import one_thread

    os.environ.setdefault("MUJOCO_GL", "egl")
    policy = load_policy(HAMMER)
    env = make_env(policy.spec.task, policy.spec.render_profile, policy.spec.cameras)
    simulation = Simulation(env, policy, Ablation())
    with one_thread():
        simulation.begin(5000)
        for step in range(10):
            if step == 3:
                simulation.set_camera(SetCamera("third_a", OFF))
            if step == 5:
                noisy = CameraState("rgb", Occlusion("noise", 0.5))
                simulation.set_camera(SetCamera("first", noisy))
            simulation.step(lambda: None)
    env.close()
    path = tmp_path_factory.mktemp("kept") / "hammer.json"
    simulation.journal.kept().write(path)
    return path


def replay(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "madviz", "replay", *words]
    return subprocess.run(command, capture_output=True, text=True)


def test_another_process_lives_it_again_to_the_bit(hammer: Path) -> None:
    asked = replay(str(hammer), "--json", "-")
    assert asked.returncode == 0, asked.stderr
    (row,) = json.loads(asked.stdout)["episodes"]
    assert row["same"] and row["steps"] == 10 and row["commands"] == 2


def test_another_episode_is_called_so(hammer: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = put(json.loads(hammer.read_text()), "episodes.0.commands", [])
    path = hammer.with_name("other.json")
    path.write_text(json.dumps(other))
    assert cli.main(["replay", str(path)]) == 1
    said = capsys.readouterr().out
    assert "DIFFER from decision 4 on: another machine, or a file that was changed" in said
