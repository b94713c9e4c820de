"""Saved sessions: what a journal writes is replayed to the bit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from msgspec import structs

from madviz import cli
from madviz.app import server
from madviz.app.server import ExploreConfig
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.guard.policy import SUFFIX
from madviz.observation.ablation import Ablation, CameraState, Occlusion
from madviz.observation.schedule import parse_schedule
from madviz.recording.frames import frames, session_of
from madviz.session.commands import (
    Pause,
    Play,
    SetCamera,
    SetPolicy,
    SetSchedule,
    SetSeed,
)
from madviz.session.frame import Frame
from madviz.session.replay import failure_words, replay_episode, replay_row, replay_words
from madviz.session.scheduled import SessionPlan
from madviz.session.session import Session
from madviz.session.session_file import (
    STREAMS,
    Hashes,
    SavedCommand,
    SavedEpisode,
    SavedPolicy,
    SavedSession,
)
from madviz.session.session_reader import parse
from madviz.session.simulation import Simulation
from madviz.types import Array, Encoded, Environment
from tests.fakes import FakePolicy, policies
from tests.sessions import Recorder
from tests.visitors import (
    CAMERAS,
    Interrupted,
    find,
    played,
    put,
    session_with,
)

OFF = CameraState("off")
HAMMER = "metaworld-hammer-mad-light"


def same(one: SavedEpisode, other: SavedEpisode) -> bool:
    return (one.sha256, one.trace, one.success, one.ended, one.steps) == (
        other.sha256,
        other.trace,
        other.success,
        other.ended,
        other.steps,
    )


@pytest.mark.parametrize("seed", range(10))
def test_whatever_a_visitor_did_is_replayed_to_the_bit(seed: int) -> None:
    saved = played(seed, 50)
    read = parse(saved.to_json().encode(), "here")
    assert read == saved and sum(episode.steps for episode in read.episodes) >= 20
    for episode in read.episodes:
        assert same(replay_episode(episode, find), episode)


def test_commands_matter_and_so_do_their_steps() -> None:
    """Or the test above would pass with a journal that forgets."""
    episode = max(played(0, 50).episodes, key=lambda one: len(one.commands))
    missed = 0
    for index in range(0, len(episode.commands), 3):
        fields = {**structs.asdict(episode)}
        fields["commands"] = episode.commands[:index] + episode.commands[index + 1 :]
        missed += not same(replay_episode(SavedEpisode(**fields), find), episode)
    assert missed >= 2


@pytest.mark.parametrize("raises", [False, True])
def test_a_replay_computes_on_one_thread_and_closes_what_it_opened(
    raises: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    episode = played(0, 50).episodes[-1]
    encode = FakePolicy.encode
    threads: list[int] = []
    closed: list[object] = []

    def watched(self: FakePolicy, views: Array, state: Array) -> Encoded:
        threads.append(torch.get_num_threads())
        if raises and len(threads) == 3:
            raise RuntimeError("it fell")
        return encode(self, views, state)

    def opened(*world: Any) -> Environment:
        env = make_env(*world)
        close = env.close
        env.close = lambda: closed.append(close())
        return env

    monkeypatch.setattr(FakePolicy, "encode", watched)
    torch.set_num_threads(2)
    with pytest.raises(RuntimeError, match="fell") if raises else nullcontext():
        replay_episode(episode, find, opened)
    assert set(threads) == {1} and torch.get_num_threads() == 2 and len(closed) == 1


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
    assert session.save().episodes[-1].sha256 == plain.journal.saved().episodes[-1].sha256


def test_a_dragged_slider_leaves_one_line() -> None:
    session = session_with([], seed=3)
    session.send(Pause())
    for strength in np.linspace(0, 1, 50):
        session.send(SetCamera("first", CameraState("rgb", Occlusion("noise", float(strength)))))
    session.send(Play())
    session.tick(1.0)
    (episode,) = session.save().episodes
    assert [one.command for one in episode.commands] == [
        SetCamera("first", CameraState("rgb", Occlusion("noise", 1.0)))
    ]


def test_settings_that_outlive_an_episode_are_in_the_next_ones_start() -> None:
    session = session_with([], seed=3)
    for command in (SetCamera("third_b", OFF), SetSeed(9)):
        session.send(command)
        session.tick(0.0)
    session.tick(1.0)
    episode = session.save().episodes[-1]
    assert (episode.seed, episode.commands) == (9, ())
    assert episode.start == (SetCamera("third_b", OFF),)
    assert same(replay_episode(episode, find), episode)


def test_the_journal_forgets_the_oldest_and_saves_no_broken_episode() -> None:
    session = session_with([], seed=0)
    for tick in range(30):
        session.send(SetSeed(tick))
        session.tick(float(tick))
    saved = session.save()
    assert [episode.seed for episode in saved.episodes] == list(range(10, 30))
    assert [episode.seed for episode in session.save(present_only=True).episodes] == [29]
    for command in (Pause(), SetSeed(30)):
        session.send(command)
    session.tick(30.0)
    assert [episode.seed for episode in session.save().episodes] == list(range(10, 30))
    with pytest.raises(UserError, match="let it run first"):
        session.save(present_only=True)  # Not the one before instead.

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
        broken.save()


def test_a_session_follows_a_saved_episode_then_is_the_visitors() -> None:
    original = played(4, 60).episodes[0]
    first = policies(original.policy.name)
    session = Session(make_env, first, policies, speed=None, script=original)
    session.tick(0.0)
    assert session.tick(9.0) is None and isinstance(session.latest, Frame)
    assert (session.latest.world.step, session.latest.pace.phase) == (
        0,
        "paused",
    )  # Nobody watches yet.
    session.send(Play())
    for tick in range(original.steps + 1):
        session.tick(float(tick))
    again = session.save().episodes[0]
    assert again.trace[: len(original.trace)] == original.trace
    session.send(SetSeed(77))
    session.tick(99.0)
    session.tick(100.0)
    assert not session.save().episodes[-1].commands


def test_the_policies_of_a_saved_episode_keep_their_guards(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    saved = played(1, 40)
    bare, guarded = (SavedPolicy(f"toy-mad{end}", "digest") for end in ("", SUFFIX))
    changed = structs.replace(saved.episodes[0], policy=guarded, commands=())
    session_file = replace(saved, episodes=(changed,))
    monkeypatch.setattr(server, "read_session", lambda file: session_file)
    for name in ("check_policies", "differences"):
        monkeypatch.setattr(server, name, lambda *_: ())
    monkeypatch.setattr(server, "finder", lambda names: lambda policy: FakePolicy(policy.name))
    _, given = server.saved_episode(ExploreConfig(replay=tmp_path))
    assert list(given) == ["guard:toy-mad"]
    swaps = (SavedCommand(0, bare), SavedCommand(0, guarded))
    plan = SessionPlan(structs.replace(changed, commands=swaps))
    plan.begin()
    for one in (bare, guarded):
        followed = structs.replace(changed, policy=bare, commands=(SavedCommand(2, one),))
        env = make_env("toy/reach")
        found: list[str] = []

        def find(policy: SavedPolicy, found: list[str] = found) -> FakePolicy:
            found.append(policy.name)
            return FakePolicy(policy.name)

        with closing(session_of(env, FakePolicy(), 5, followed, find)) as recorded:
            list(frames(recorded, 4))
        assert found[-1] == one.name
    session = Recorder()
    session.at(0.0)
    assert session._stage.simulation is not None
    due = plan.due(session._stage.simulation)
    assert due == [SetPolicy("toy-mad"), SetPolicy("guard:toy-mad")]


def test_a_difference_is_found_and_explained() -> None:
    saved = played(1, 40)
    episode = saved.episodes[0]
    fields = {**structs.asdict(episode), "policy": SavedPolicy("toy-mad", "older")}
    fields["trace"] = episode.trace[:8] + "0000" + episode.trace[12:]
    fields["sha256"] = structs.replace(episode.sha256, actions="0" * 64)
    other = SavedSession((SavedEpisode(**fields),), {**saved.versions, "numpy": "0.1"})
    row = replay_row(other.episodes[0], other, find)
    assert not row["same"] and row["first_difference"] == 3
    assert row["same_bits"] == {"actions": False, "rewards": True, "success": True}
    words = replay_words({"schema": 1, "file": "x", "same": False, "episodes": [row]})
    assert "actions DIFFER from decision 3 on: toy-mad had the digest older" in words
    assert "numpy was 0.1" in words


def test_failures_of_an_episode_in_words() -> None:
    session = session_with([], seed=0)
    session.send(SetSchedule(parse_schedule(["third_a@2-4", "first=black@3"], CAMERAS)))
    for tick in range(7):
        session.tick(float(tick))
    assert failure_words(session.save().episodes[0]) == ["third_a@2-4", "first=black@3"]


# --- In another process -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def hammer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten decisions of a bundled policy, with one camera dropped and one occluded."""
    from madviz.measure.episodes import one_thread
    from madviz.policies.checkpoint import load_policy

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
    path = tmp_path_factory.mktemp("saved") / "hammer.json"
    simulation.journal.saved().write(path)
    return path


def replay(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "madviz", "replay", *words]
    return subprocess.run(command, capture_output=True, text=True)


def test_another_process_replays_it_to_the_bit(hammer: Path) -> None:
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


def kept_by_a_site(episode: SavedEpisode, success: bool) -> SavedSession:
    """The episode as a browser would have saved it: other last bits, hence other hashes."""
    wrong = Hashes(**dict.fromkeys(STREAMS, "0" * 64))
    fields = {**structs.asdict(episode), "sha256": wrong, "trace": "0" * len(episode.trace)}
    return SavedSession((SavedEpisode(**{**fields, "success": success}),), {}, "site")


def test_a_session_of_a_site_is_compared_by_its_outcome_not_by_bits() -> None:
    episode = played(0, 50).episodes[0]
    for success in (episode.success, not episode.success):
        saved = kept_by_a_site(episode, success)
        read = parse(saved.to_json().encode(), "here")
        assert read == saved and read.made_by == "site"
        row = replay_row(read.episodes[0], read, find)
        assert row["compared"] == "outcome" and row["first_difference"] is None
        assert row["same"] == (success == episode.success)
        words = replay_words({"schema": 1, "file": "", "same": row["same"], "episodes": [row]})
        assert "outcomes are compared, not bits" in words and ("DIFFERS" in words) != row["same"]


def test_a_session_of_madviz_is_still_compared_to_the_bit() -> None:
    saved = played(0, 50)
    assert "made_by" not in json.loads(saved.to_json())
    other = SavedSession(kept_by_a_site(saved.episodes[0], True).episodes, saved.versions)
    row = replay_row(other.episodes[0], other, find)
    assert row["compared"] == "bits" and not row["same"]


def test_nobody_else_makes_sessions() -> None:
    content = json.loads(played(0, 50).to_json())
    with pytest.raises(UserError, match="made_by"):
        parse(json.dumps({**content, "made_by": "somebody"}).encode(), "here")
