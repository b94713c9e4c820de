"""Policies and simulators that come, go and fail under a running session."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from madviz.envs.registry import make_env
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.measure import mean_picture
from madviz.observation.ablation import Ablation, CameraState, Occlusion
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement, MoveCamera
from madviz.observation.schedule import Event
from madviz.session.commands import (
    Compare,
    Pause,
    Play,
    Reset,
    SetAutoNext,
    SetCamera,
    SetPolicy,
    SetSchedule,
    SetSeed,
    SetSpeed,
    StepOnce,
)
from madviz.session.comparison import open_simulation
from madviz.session.episode_record import EpisodeRecord
from madviz.session.frame import NoFrame, words
from madviz.session.replay import replay_episode
from madviz.session.session import Session
from madviz.types import CameraSpec
from tests.fakes import AllOrNothing, Chunked, FakePolicy, Silent, policies
from tests.sessions import OFF, Recorder, any_task, elsewhere


def test_a_policy_that_needs_every_stream_says_so():
    session = Recorder(AllOrNothing("toy-stack"))
    session.at(0.0)
    mute = session.ask(SetCamera("first", OFF)).world
    assert np.isnan(session.frames[-1].action).all()
    assert mute.change and words(mute.change, mute.env).endswith("cannot act on that")
    assert "cannot act on 'third_a+third_b'" in session.steps(1).pace.error
    back = session.ask(SetCamera("first", CameraState("rgb"))).world
    assert back.change and words(back.change, back.env).endswith("this policy can act again")
    pace = session.frames[-1].pace
    assert (pace.error, pace.phase) == ("", "playing"), "it goes on by itself"
    step = session.frames[-1].world.step
    assert session.steps(2).world.step == step + 2


def test_one_step_that_lacked_a_camera_stays_one_step():
    session = Recorder(AllOrNothing("toy-stack"))
    session.at(0.0)
    session.ask(Pause())
    session.ask(SetCamera("first", OFF))
    assert "cannot act on" in session.ask(StepOnce()).pace.error
    other = session.ask(SetCamera("third_a", OFF)).pace.error
    assert "cannot act on 'third_a+third_b'" in other, "still one camera too few"
    session.ask(SetCamera("third_a", CameraState("rgb")))
    pace = session.ask(SetCamera("first", CameraState("rgb"))).pace
    assert (pace.error, pace.phase) == ("", "paused")


def test_policies_swap_in_mid_episode_and_camera_settings_stay(session: Recorder):
    session.ask(SetCamera("third_a", OFF))
    before = session.steps(5)
    after = session.ask(SetPolicy("toy-other"))
    assert (after.world.policy.name, after.world.step) == ("toy-other", before.world.step)
    assert after.condition.subset == "first+third_b"
    np.testing.assert_array_equal(after.world.arrived["first"], before.world.arrived["first"])
    six = session.ask(SetPolicy("toy-rgbd"))
    assert six.world.probe.masks.shape == (64, 6)
    assert six.condition.subset == "first+third_b"
    assert session.steps(2).world.step == before.world.step + 2


@pytest.mark.parametrize("how", [Occlusion("freeze"), Occlusion("delay", 1.0)])
def test_another_policy_of_the_same_pictures_changes_nothing_of_a_broken_camera(
    session: Recorder, how: Occlusion
):
    session.steps(3)
    session.ask(SetCamera("first", CameraState(occlusion=how)))
    before = session.steps(9).world.arrived["first"]
    after = session.ask(SetPolicy("toy-other")).world
    assert after.policy.name == "toy-other"
    np.testing.assert_array_equal(after.arrived["first"], before)


def test_a_camera_that_is_on_again_gives_depth_to_a_policy_that_takes_it(session: Recorder):
    on = CameraState("rgb")  # As in training, for a policy of colour.
    session.ask(SetCamera("third_a", OFF))
    session.ask(SetCamera("third_a", on))
    compared = session.ask(Compare("toy-rgbd", session.frames[-1].world.ablation))
    assert compared.second is not None and str(compared.second.condition) == "all"
    assert compared.linked
    session.ask(SetCamera("third_b", OFF))
    both = session.ask(SetCamera("third_b", on)).second
    assert both is not None and str(both.condition) == "all"
    session.ask(Compare(None))
    assert str(session.ask(SetPolicy("toy-rgbd")).condition) == "all"
    session.ask(SetCamera("first", on))  # Somebody wants colour alone.
    assert str(session.ask(SetPolicy("toy-mad")).condition) == "all"


def test_a_camera_that_the_policy_does_not_use_changes_nothing_of_an_episode():
    spec = FakePolicy().spec
    record = EpisodeRecord()
    ablation = Ablation({"third_c": CameraState("off"), "first": CameraState("off")})
    record.note(spec, Condition("third_a+third_b"), ablation)
    cameras = (*make_env("toy/reach").spec.cameras, CameraSpec("third_c", "Third C", fovy=50))
    assert [deed.label for deed in record.deeds(cameras)] == ["First person"]


@pytest.mark.parametrize("auto_next", [True, False])
@pytest.mark.parametrize("command", [SetPolicy("elsewhere"), Compare("toy-other")])
def test_what_begins_an_episode_ends_the_end_of_the_last_one(command, auto_next: bool):
    session = Recorder(env_factory=any_task, load=elsewhere)
    session.at(0.0)
    session.ask(SetAutoNext(auto_next))
    assert session.steps(25).pace.phase == "ended"
    begun = session.ask(command)
    assert (begun.world.step, begun.pace.phase) == (0, "playing")
    assert session.at(session.time + 0.05) == pytest.approx(session.time + 0.05)
    later = session.steps(2)
    assert (later.world.step, later.pace.phase) == (2, "playing")


def test_an_unknown_policy_leaves_the_old_one(session: Recorder):
    frame = session.ask(SetPolicy("nonsense"))
    assert frame.world.policy.name == "toy-mad" and "nonsense" in frame.pace.error
    assert session.ask(Play()).pace.error == ""


def test_a_policy_may_come_by_its_name():
    session = Recorder("toy-other")
    assert session.latest is None
    session.at(0.0)
    assert session.frames[-1].world.policy.name == "toy-other"


def test_a_name_that_nobody_knows_is_said_and_another_policy_helps():
    session = Recorder("nonsense")
    session.at(0.0)
    assert isinstance(session.latest, NoFrame) and "unknown policy" in session.latest.error
    session.ask(SetPolicy("toy-other"))
    assert session.frames[-1].world.policy.name == "toy-other"


def test_a_policy_of_another_world_is_refused_and_the_old_one_stays():
    def odd(name: str) -> FakePolicy:
        policy = policies("toy-other")
        policy.spec = replace(policy.spec, state_dim=24)
        return policy

    session = Recorder(load=odd)
    session.at(0.0)
    for command in (SetPolicy("toy-other"), Compare("toy-other")):
        frame = session.ask(command)
        assert "state numbers = 24, this environment has 6" in frame.pace.error
        assert frame.world.policy.name == "toy-mad" and frame.second is None


def test_a_swapped_policy_gets_the_past_it_would_have_had():
    swapped, fresh = Recorder(), Recorder(policies("toy-rgbd"))
    for session in (swapped, fresh):
        session.at(0.0)
        session.ask(SetAutoNext(False))
    action = np.zeros(2, np.float32)
    for session in (swapped, fresh):
        # The same actions for both, so that only the policy's past can differ.
        simulation = session._stage.simulation
        assert simulation is not None
        for _ in range(6):
            simulation.probe.readout.action[:] = action
            simulation.step(lambda: None)
    after = swapped.ask(SetPolicy("toy-rgbd"))
    expected = fresh.ask(Pause())
    np.testing.assert_array_equal(after.world.probe.features, expected.world.probe.features)


@pytest.mark.parametrize("before", [FakePolicy, Chunked])
def test_a_policy_that_gives_no_answer_is_refused_and_the_old_one_stays(before: Callable):
    fresh = Silent("toy-other")
    fresh.silent = True
    session = Recorder(before(), load=lambda _: fresh)
    untouched = Recorder(before())
    for one in (session, untouched):
        one.at(0.0)
        one.steps(3)
    refused = session.ask(SetPolicy("toy-other"))
    assert "expected an answer" in refused.pace.error
    assert refused.world.policy.name == before().spec.name
    session.ask(Play())  # A decision is due at once.
    left = session.steps(1)
    right = untouched.steps(2)
    assert left.world.step == right.world.step == 5
    np.testing.assert_array_equal(left.action, right.action)
    fresh.silent = False
    assert session.ask(SetPolicy("toy-other")).world.policy.name == "toy-other"


def test_a_simulator_that_cannot_start_is_reported_and_can_be_retried():
    attempts = []

    def factory(task, profile, cameras):
        attempts.append(task)
        if len(attempts) == 1:
            raise UserError("no OpenGL here")
        return make_env(task, profile)

    session = Recorder(env_factory=factory)
    assert session.at(0.0) is None
    assert isinstance(session.latest, NoFrame) and "no OpenGL here" in session.latest.error
    assert session.at(1.0) is None and len(attempts) == 1
    assert session.ask(Play()).world.step == 0


def test_unknown_camera_is_an_error_the_page_survives(session: Recorder):
    frame = session.ask(SetCamera("fourth", OFF))
    assert "unknown camera 'fourth'" in frame.pace.error
    assert session.ask(Play()).pace.error == ""


@pytest.mark.parametrize("rate", [0.0, -1.0, 1e9, float("nan")])
def test_absurd_speeds_are_refused(rate):
    with pytest.raises(UserError, match="speed"):
        SetSpeed(rate)


def test_thread_closes_its_environment():
    closed = []

    class Closing(ToyReach):
        def close(self):
            closed.append(True)

    session, opened = Session(lambda *_: Closing(), FakePolicy(), speed=None), threading.Event()
    session.subscribe(lambda _: opened.set())
    session.start()
    assert opened.wait(60)  # One that was never opened has nothing to close.
    session.close()
    assert closed == [True]
    assert session._thread is not None and not session._thread.is_alive()


def test_a_session_closed_in_mid_step_ends_though_it_is_paused():
    """What wakes it from its wait is read in mid-step, with the commands about cameras."""
    drawing, go_on = threading.Event(), threading.Event()

    class Slow(ToyReach):
        def step(self, action):
            drawing.set()
            assert go_on.wait(60)
            return super().step(action)

    session, opened = Session(lambda *_: Slow(), FakePolicy(), speed=0.1), threading.Event()
    session.subscribe(lambda _: opened.set())
    session.send(Pause())
    session.start()
    assert opened.wait(60)
    session.send(StepOnce())
    assert drawing.wait(60)
    session.close(timeout=0.0)
    go_on.set()
    assert session._thread is not None
    session._thread.join(20)
    assert not session._thread.is_alive()


def test_what_cannot_be_shown_still_ends_with_its_environment_closed(monkeypatch):
    """Every picture fails, even that of the failure; so does one of those who listen."""
    closed, told = [], threading.Event()

    class Closing(ToyReach):
        def close(self):
            closed.append(True)

    def blind(*_, **__):
        raise RuntimeError("no picture today")

    def deaf(_):
        raise RuntimeError("not listening")

    session = Session(lambda *_: Closing(), FakePolicy(), speed=None)
    monkeypatch.setattr(session._stage, "frame", blind)
    session.subscribe(deaf)
    session.subscribe(lambda _: told.set())
    session.start()
    assert told.wait(60)
    assert isinstance(session.latest, NoFrame) and "no picture today" in session.latest.error
    session.send(Play())
    session.close()
    assert session._thread is not None and not session._thread.is_alive()
    assert closed == [True]


def test_a_policy_that_cannot_live_in_its_environment_leaves_none_open(monkeypatch):
    closed = []

    class Closing(ToyReach):
        def close(self):
            closed.append(True)

    def broken(*_):
        raise RuntimeError("no place for it")

    monkeypatch.setattr("madviz.session.simulation.PolicyInput", broken)
    with pytest.raises(RuntimeError, match="no place for it"):
        open_simulation(Closing(), FakePolicy(), Ablation(), seed=0)
    assert closed == [True]


def refuse(*_, **__):
    raise RuntimeError("no picture yet")


class Closed(ToyReach):
    """Counts how often it is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.closed = 0

    def close(self):
        self.closed += 1


@pytest.mark.parametrize("broken", ["reset", "view", "pose"])
@pytest.mark.parametrize("command", [Play(), StepOnce(), SetPolicy("toy-other"), Reset()])
def test_a_first_episode_that_cannot_begin_leaves_nothing_open_and_can_be_retried(
    monkeypatch, broken, command
):
    worlds: list[Closed] = []

    def built(*_):
        worlds.append(Closed())
        if len(worlds) == 1:
            monkeypatch.setattr(worlds[0], broken, refuse)
        return worlds[-1]

    session = Recorder(env_factory=built)
    session.at(0.0)
    assert isinstance(session.latest, NoFrame) and "no picture yet" in session.latest.error
    assert [world.closed for world in worlds] == [1]
    frame = session.ask(command)
    assert (frame.pace.error, frame.world.step) == ("", 0)
    assert [world.closed for world in worlds] == [1, 0]
    assert session.ask(StepOnce()).world.step == 1


@pytest.mark.parametrize("broken", ["reset", "view", "pose"])
@pytest.mark.parametrize("command", [Play(), StepOnce(), SetPolicy("toy-other"), Reset()])
def test_a_later_episode_that_cannot_begin_leaves_a_session_that_goes_on(
    monkeypatch, broken, command
):
    world = ToyReach()
    session = Recorder(env_factory=lambda *_: world)
    session.at(0.0)
    session.steps(3)
    with monkeypatch.context() as patch:
        patch.setattr(world, broken, refuse)
        frame = session.ask(Reset())
        assert "no picture yet" in frame.pace.error and frame.world.step == 3
    assert session.ask(command).pace.error == ""


def test_a_replay_closes_the_player_and_the_environment_once():
    policy, worlds = Chunked(), list[Closed]()

    def built(*_):
        worlds.append(Closed())
        return worlds[-1]

    session = Recorder(policy)
    session.at(0.0)
    session.steps(6)
    (episode,) = session.save().episodes
    again = replay_episode(episode, lambda _: policy, built)
    assert again.sha256 == episode.sha256
    assert policy.players[-1].closed and not policy.players[0].closed
    with pytest.raises(UserError, match="found ended after 6"):
        replay_episode(structs.replace(episode, ended=True), lambda _: policy, built)
    with pytest.raises(UserError, match="expected policies for toy/reach"):
        replay_episode(episode, lambda _: FakePolicy(task="metaworld/hammer"), built)
    assert [world.closed for world in worlds] == [1, 1, 1]


def test_a_policy_that_gave_no_answer_is_asked_once_more():
    """It decides from the newest pictures, and what is planned at that step still comes."""
    policy = Silent()
    session = Recorder(policy)
    session.at(0.0)
    session.ask(SetSchedule((Event(6, "first", dropped=True),)))
    session.steps(5)
    policy.silent = True
    failed = session.steps(1)
    assert (failed.world.step, failed.pace.phase) == (6, "paused") and failed.pace.error
    policy.silent = False
    session.ask(Play())
    frame = session.steps(5)
    assert not frame.pace.error and frame.condition.subset == "third_a+third_b"
    saved = session.save().episodes[-1]
    assert [one.step for one in saved.commands] == [6]
    assert replay_episode(saved, lambda _: FakePolicy()).sha256 == saved.sha256


def test_an_episode_whose_last_answer_fails_has_ended():
    policy = Silent()
    session = Recorder(policy)
    session.at(0.0)
    session.steps(24)
    policy.silent = True
    assert len(session.steps(1).world.outcomes) == 1


class Blind(ToyReach):
    """Cannot draw while it is ``blind``."""

    blind = False
    taken = 0

    def step(self, action):
        self.taken += 1
        return super().step(action)

    def view(self, camera: str, size: int | None = None):
        if self.blind:
            raise RuntimeError("no picture")
        return super().view(camera, size)


@pytest.mark.parametrize("of", ["mean picture", "move", "answer"])
def test_a_camera_command_that_fails_changes_nothing(of: str, monkeypatch: pytest.MonkeyPatch):
    def no_pictures(*_):
        raise RuntimeError("no pictures")

    monkeypatch.setattr(mean_picture, "mean_pictures", no_pictures)
    env = Blind()
    policy = Silent()
    session = Recorder(policy, env_factory=lambda *_: env)
    untouched = Recorder()
    for one in (session, untouched):
        one.at(0.0)
        one.steps(3)
    env.blind = of == "move"
    policy.silent = of == "answer"
    kind = "mean" if of == "mean picture" else "black"
    command = (
        MoveCamera("first", Displacement(right=0.1))
        if of == "move"
        else SetCamera("first", CameraState("rgb", Occlusion(kind)))
    )
    failed = session.ask(command)
    assert failed.pace.error and failed.world.change is None
    assert failed.world.ablation == untouched.frames[-1].world.ablation
    env.blind = False
    policy.silent = False
    session.ask(Play())  # A decision is due at once.
    left = session.steps(1)
    right = untouched.steps(2)
    assert left.world.step == right.world.step == 5
    np.testing.assert_array_equal(left.world.probe.features, right.world.probe.features)
    np.testing.assert_array_equal(left.action, right.action)


def test_after_a_picture_that_did_not_come_no_decision_is_taken_until_the_seed_starts_again():
    env = Blind()
    session = Recorder(env_factory=lambda *_: env)
    session.at(0.0)
    session.steps(5)
    env.blind = True
    session.steps(1)
    env.blind = False
    for _ in range(2):
        frame = session.ask(Play())
        assert (frame.world.step, env.taken) == (5, 6)
        assert "at step 5 of seed" in frame.pace.error and "found it elsewhere" in frame.pace.error
    frame = session.ask(Reset())
    assert not frame.pace.error and session.steps(2).world.step == 2


@pytest.mark.parametrize("command", [Play(), StepOnce()])
def test_after_a_first_picture_that_did_not_come_the_seed_that_was_asked_for_begins(command):
    env = Blind()
    session = Recorder(env_factory=lambda *_: env)
    session.at(0.0)
    session.steps(5)
    env.blind = True
    session.ask(SetSeed(2007))
    env.blind = False
    frame = session.ask(command)
    assert (frame.world.seed, frame.world.step, env.taken) == (2007, 0, 5)
    assert not frame.pace.error and session.ask(StepOnce()).world.step == 1


def test_play_begins_the_seed_on_both_sides_where_b_could_not():
    envs: list[Blind] = []

    def built(*_):
        envs.append(Blind())
        return envs[-1]

    session = Recorder(env_factory=built)
    session.at(0.0)
    session.ask(Compare("toy-mad"))
    envs[1].blind = True
    assert session.ask(SetSeed(2007)).pace.error
    envs[1].blind = False
    frame = session.ask(Play())
    assert frame.second is not None and not frame.pace.error
    assert (frame.world.seed, frame.second.world.seed, frame.world.step) == (2007, 2007, 0)


def test_an_episode_whose_first_answer_fails_has_left_the_one_before():
    policy = Silent()
    session = Recorder(policy)
    session.at(0.0)
    session.ask(SetCamera("first", OFF))
    session.steps(4)
    session.ask(SetSchedule((Event(0, "third_a", dropped=True),)))
    policy.silent = True
    session.ask(Reset())
    policy.silent = False
    frame = session.ask(Play())
    assert not frame.pace.error and len(frame.history) == frame.world.step + 1 < 4
    assert not frame.world.ablation.mask(policy.spec.streams)[1]


def test_an_episode_that_cannot_begin_is_passed_by():
    """*Next* leads on and not to the same one again, for example past a broken recorded episode."""
    env = Blind()
    session = Recorder(env_factory=lambda *_: env)
    session.at(0.0)
    env.blind = True
    assert session.ask(Reset(next_seed=True)).pace.error
    env.blind = False
    assert session.ask(Reset(next_seed=True)).world.seed == 2002
