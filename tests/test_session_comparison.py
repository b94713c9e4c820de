"""A against B in lock-step: the same seeds, pairs only of untouched episodes, an honest tally."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from madviz.app.panels.comparison import comparison_html
from madviz.app.success_rates import SuccessRates
from madviz.envs.registry import make_env
from madviz.envs.toy import ToyReach
from madviz.observation.ablation import Ablation, CameraState
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement, MoveCamera
from madviz.observation.schedule import Event
from madviz.session.commands import Compare, Link, Play, Scrub, SetCamera, SetPolicy, SetSchedule
from madviz.session.comparison import tally
from madviz.session.ending import ending_of
from madviz.session.episode_record import EpisodeRecord
from madviz.session.frame import Outcome, Pair
from madviz.types import Array, TimeStep
from tests.fakes import AllOrNothing, Chunked, FakePolicy, Silent, policies
from tests.sessions import Recorder
from tests.test_timeline import Played

OFF = CameraState("off")
FIRST_OFF = Ablation({"first": OFF})


def test_both_sides_play_the_same_seed_step_by_step() -> None:
    play = Played()
    frame = play(3, Compare("toy-mad"))
    assert frame.second is not None and (frame.world.step, frame.second.world.step) == (0, 0)
    for _ in range(5):
        frame = play(1)
        assert frame.second is not None and frame.second.world.step == frame.world.step
        np.testing.assert_array_equal(frame.second.action, frame.action)
    frame = play(20)
    assert frame.ended and len(frame.pairs) == 1
    assert frame.pairs[0].first.success == frame.pairs[0].second.success
    play(2)  # The page holds an ended episode for two seconds.
    frame = play(1)
    assert frame.second is not None and frame.world.seed == frame.second.world.seed


def test_what_happens_to_a_does_not_happen_to_b() -> None:
    play = Played()
    frame = play(Compare("toy-other", FIRST_OFF), 2, SetCamera("third_a", OFF), 1)
    assert frame.second is not None
    assert frame.condition.subset == "first+third_b"
    assert (frame.second.world.policy.name, frame.second.condition.subset) == (
        "toy-other",
        "third_a+third_b",
    )
    assert not np.array_equal(frame.second.action, frame.action)


def test_what_happens_to_a_happens_to_b_until_they_are_unlinked() -> None:
    play = Played()
    frame = play(Compare("toy-other"), 2, SetCamera("third_a", OFF))
    assert frame.second is not None and frame.linked
    assert frame.condition.subset == frame.second.condition.subset == "first+third_b"
    frame = play(MoveCamera("first", Displacement(right=0.1)), 1)
    assert frame.second is not None and frame.second.condition == frame.condition
    frame = play(Link(False), SetCamera("third_b", OFF), 1)
    assert frame.second is not None and not frame.linked
    assert (frame.condition.subset, frame.second.condition.subset) == ("first", "first+third_b")
    frame = play(Link(True))
    assert frame.second is not None and frame.second.condition == frame.condition


def test_a_camera_that_fails_by_itself_fails_on_both_sides_at_the_same_step() -> None:
    play = Played()
    frame = play(Compare("toy-other"), SetSchedule((Event(4, "first", dropped=True),)), 4)
    for seen in (frame, play(3)):
        assert seen.second is not None
        assert seen.second.condition == seen.condition
    assert frame.world.step >= 4 and frame.condition.subset == "third_a+third_b"
    frame = play(SetSchedule(()))
    assert frame.second is not None and frame.second.condition.subset == "all"


def test_cameras_that_begin_apart_are_not_linked() -> None:
    frame = Played()(Compare("toy-mad", FIRST_OFF), 1)
    assert frame.second is not None and not frame.linked
    assert (frame.condition.subset, frame.second.condition.subset) == ("all", "third_a+third_b")


def test_both_sides_of_a_switched_camera_make_a_pair_in_the_next_episode() -> None:
    play = Played()
    play(Compare("toy-mad"), 3, SetCamera("first", OFF), 25)
    frame = play(40)
    assert [str(pair.sides[0][1]) for pair in frame.pairs] == ["third_a+third_b"] * len(frame.pairs)
    assert frame.pairs


class Short(ToyReach):
    """Ends after five decisions, as a task does that success ends."""

    def step(self, action: Array) -> TimeStep:
        found = super().step(action)
        return replace(found, last=found.last or self._step >= 5)


def test_where_a_ends_first_b_goes_on_to_its_own_end() -> None:
    made: list[ToyReach] = []

    def factory(*args: Any, **options: Any) -> ToyReach:
        env = make_env(*args, **options)
        assert isinstance(env, ToyReach)
        env.__class__ = ToyReach if made else Short
        made.append(env)
        return env

    play = Played(factory=factory)
    frame = play(Compare("toy-mad"), 4)
    assert not frame.ended and not frame.pairs
    frame = play(1)
    assert frame.ended and frame.world.step == 5 and frame.second is not None
    assert frame.second.world.step == frame.world.env.horizon
    assert len(frame.pairs) == 1


def test_two_policies_in_one_episode_are_said_to_be_two() -> None:
    frame = Played()(SetCamera("first", OFF), 3, SetPolicy("toy-other"), 25)
    words = ending_of(frame, SuccessRates().best)
    assert words is not None and "(it acted last)" in words.result
    frame = Played()(SetCamera("first", OFF), 25)
    words = ending_of(frame, SuccessRates().best)
    assert words is not None and "acted last" not in words.result


def test_a_memory_that_begins_in_mid_episode_counts_for_no_condition() -> None:
    for policy, counts in ((Chunked(), False), (FakePolicy(), True)):
        record = EpisodeRecord()
        record.swapped(policy)
        record.note(policy.spec, Condition("all"), Ablation())
        assert record.outcome(policy.spec, 0, True, []).condition == Condition("all")
        record.swapped(policy)
        record.note(policy.spec, Condition("all"), Ablation())
        assert (record.outcome(policy.spec, 0, True, []).condition is not None) == counts


def test_only_untouched_episodes_make_a_pair() -> None:
    play = Played()
    assert play(Compare("toy-mad"), 25).pairs
    touched = Played()
    assert not touched(Compare("toy-mad"), 5, SetCamera("first", OFF), 20).pairs
    forked = Played()
    assert not forked(Compare("toy-mad"), 9, Scrub(4), SetPolicy("toy-mad"), 1, 25).pairs


def test_ending_b_and_starting_another_forgets_the_pairs() -> None:
    play = Played()
    assert play(Compare("toy-mad"), 25).pairs
    frame = play(Compare(None))
    assert frame.second is None and not frame.pairs
    assert "Start B" in comparison_html(frame)


def test_looking_back_says_nothing_of_starting_b() -> None:
    frame = Played()(Compare("toy-mad"), 5, Scrub(2))
    assert frame.past and "Start B" not in comparison_html(frame)


def test_a_policy_of_another_task_has_nothing_to_compare() -> None:
    stranger = FakePolicy("stranger", task="metaworld/hammer")
    play = Played(load=lambda name: stranger)
    frame = play(Compare("stranger"))
    assert frame.pace.error.startswith("expected a policy for toy/reach") and frame.second is None


def test_the_tally_counts_each_seed_once_and_one_comparison_only() -> None:
    spec = FakePolicy().spec
    blank = Outcome(spec, 0, True, {}, Condition("all"))

    def ended(seed: int, first: bool, second: bool, subset: str = "all") -> Pair:
        a = replace(blank, seed=seed, success=first, condition=Condition(subset))
        return Pair(a, replace(blank, seed=seed, success=second))

    pairs = (
        ended(1, True, True),
        ended(2, True, False),
        ended(2, True, False),
        ended(3, False, False),
        ended(4, False, True, "first"),
    )
    counted = tally(pairs, pairs[0].sides)
    assert (counted.both, counted.first_only, counted.second_only, counted.neither) == (1, 1, 0, 1)
    assert tally(pairs, pairs[-1].sides).n == 1


def test_the_panel_says_what_the_pairs_say() -> None:
    frame = Played()(Compare("toy-mad"), 3)
    assert "None yet" in comparison_html(frame)
    frame = Played()(Compare("toy-mad"), 25)
    html = comparison_html(frame)
    assert "n = 1 pairs" in html and "Every pair came out alike." in html


def test_the_panel_says_that_sides_differ_when_that_holds_after_every_look() -> None:
    frame = Played()(Compare("toy-mad"), 3)
    spec, condition = frame.world.policy, frame.condition
    blank = Outcome(spec, 0, True, {}, condition)
    for wins, said in ((6, "No difference can be seen yet."), (8, "They differ.")):
        pairs = tuple(
            Pair(replace(blank, seed=seed), replace(blank, seed=seed, success=False))
            for seed in range(wins)
        )
        assert said in comparison_html(replace(frame, pairs=pairs))


def test_cameras_set_before_the_first_decision_make_a_pair() -> None:
    play = Played()
    frame = play(Compare("toy-mad"), SetCamera("first", OFF), 25)
    (pair,) = frame.pairs
    assert [str(one.condition) for one in (pair.first, pair.second)] == ["third_a+third_b"] * 2


@pytest.mark.parametrize("name", ["nonsense", "stranger", "toy-rgbd"])
def test_a_refused_comparison_leaves_the_one_that_runs(name: str) -> None:
    """Refused: a name that nobody knows, another task, an environment that cannot begin."""
    worlds: list[World] = []

    class World(ToyReach):
        closed = False

        def reset(self, seed: int):
            if self in worlds[2:]:
                raise RuntimeError("no third world")
            return super().reset(seed)

        def close(self) -> None:
            self.closed = True

    def built(*_):
        worlds.append(World())
        return worlds[-1]

    stranger = FakePolicy("stranger", task="metaworld/hammer")
    play = Played(
        factory=built, load=lambda name: stranger if name == "stranger" else policies(name)
    )
    before = play(Compare("toy-other"), 25)
    frame = play(Compare(name))
    assert frame.pace.error and frame.second is not None
    assert frame.second.world.policy.name == "toy-other" and frame.second.world.step == 25
    assert len(frame.pairs) == 1 and frame.pairs == before.pairs
    assert [world.closed for world in worlds] == [False, False, True][: len(worlds)]
    after = play(Play(), 25)
    assert not after.pace.error and len(after.pairs) == 2
    assert play(Compare(None)).second is None
    assert worlds[1].closed and not worlds[0].closed


def test_a_camera_touched_while_a_step_is_drawn_is_touched_on_both_sides() -> None:
    class Slow(ToyReach):
        def view(self, camera: str, size: int | None = None):
            if waiting and camera == "third_a":
                play.session.send(waiting.pop())
            return super().view(camera, size)

    waiting: list[SetCamera] = []
    play = Played(factory=lambda *_: Slow())
    play(Compare("toy-mad"), 2)
    waiting.append(SetCamera("first", OFF))
    frame = play(1)
    assert frame.second is not None and frame.world.step == frame.second.world.step == 3
    assert frame.condition.subset == frame.second.condition.subset == "third_a+third_b"


def test_where_b_cannot_act_a_waits_for_it() -> None:
    play = Played(load=AllOrNothing)
    play(Compare("toy-stack"), SetSchedule((Event(3, "first", dropped=True),)), 4)
    for _ in range(3):
        frame = play(Play())
        assert frame.second is not None and "cannot act" in frame.pace.error
        assert frame.world.step == frame.second.world.step == 3
    frame = play(SetCamera("first", CameraState("rgb")), Play(), 4)
    assert frame.second is not None and not frame.pace.error
    assert frame.world.step == frame.second.world.step > 3


def test_a_side_that_gives_no_answer_leaves_the_two_in_step() -> None:
    first = Silent()
    second = Silent("toy-silent")
    session = Recorder(first, load=lambda _: second)
    session.at(0.0)
    session.ask(Compare("toy-silent"), SetSchedule((Event(3, "first", dropped=True),)))
    session.steps(2)
    for step, side in ((3, first), (4, second)):
        side.silent = True
        assert session.steps(1).pace.error
        side.silent = False
        session.ask(Play())
        frame = session.ask()
        assert frame.second is not None and not frame.pace.error
        assert frame.world.step == frame.second.world.step == step
        assert frame.condition.subset == frame.second.condition.subset == "third_a+third_b"
