"""The words at the end of an episode, and how long they stay."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from madviz.envs.registry import TASKS
from madviz.envs.tasks import DONE, done_words
from madviz.envs.toy import ToyReach
from madviz.measure.statistics import Paired, SuccessRate
from madviz.observation.ablation import CameraState, Occlusion
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement, MoveCamera
from madviz.recording.frames import frames
from madviz.session.commands import Compare, Scrub, SetCamera, SetSpeed
from madviz.session.ending import (
    EndedSide,
    ending,
    ending_of,
    guard_words,
    guess_words,
    needs_words,
)
from madviz.session.frame import Deed
from madviz.session.pace import HOLD, HOLD_TO_READ
from madviz.session.session import Session
from madviz.types import Array, PolicySpec, TimeStep
from tests.fakes import FakePolicy
from tests.sessions import BLACK, OFF, Recorder

CASES = json.loads((Path(__file__).parent / "site" / "endings.json").read_text())
"""The site's JavaScript is tested on the same table."""


def measured(spec: PolicySpec, condition: Condition) -> SuccessRate:
    return SuccessRate.of(70, 100) if condition == Condition("all") else SuccessRate.of(1, 4)


def side(values: dict[str, Any]) -> EndedSide:
    deeds = tuple(Deed(*deed) for deed in values["deeds"])
    rate = SuccessRate.of(values["successes"], values["n"])
    departure = tuple(values["departure"]) if "departure" in values else None
    return EndedSide(values["label"], values["success"], rate, deeds, departure)


@pytest.mark.parametrize("case", CASES, ids=[case["words"][:90] for case in CASES])
def test_the_words_are_those_of_the_table(case: dict[str, Any]) -> None:
    sides = [side(values) for values in case["sides"]]
    words = ending(sides, tuple(case["done"]))
    assert str(words) == case["words"]
    if "guess" in case:
        assert guess_words(case["guess"], words.winners) == case["guess_words"]


NEEDS = json.loads((Path(__file__).parent / "site" / "needs.json").read_text())
LABELS: tuple[str, ...] = ("First person", "Third A", "Third B")


@pytest.mark.parametrize("case", NEEDS, ids=[str(case["wins"]) for case in NEEDS])
def test_which_cameras_a_policy_needs_is_said_where_it_is_decided(case: dict[str, Any]) -> None:
    rates = [SuccessRate.of(won, 100) for won in case["wins"]]
    rates += [SuccessRate.of(0, 0)] * (4 - len(rates))
    without = dict(zip(LABELS, rates[1:], strict=True))
    assert needs_words("P", rates[0], without) == case["words"]
    assert needs_words("P", rates[0], dict(list(without.items())[:2])) == ""


def test_every_task_says_what_was_done() -> None:
    assert set(TASKS) == set(DONE)
    assert done_words("own:make") == ("succeed", "succeeded")


def test_an_episode_says_what_befell_its_cameras(session: Recorder) -> None:
    session.steps(4)
    session.ask(SetCamera("first", OFF))
    session.ask(SetCamera("third_a", CameraState(occlusion=Occlusion("noise", 0.5))))
    session.steps(3)
    session.ask(SetCamera("third_a", CameraState(occlusion=Occlusion("noise", 0.7))))
    session.ask(SetCamera("third_b", BLACK))
    session.steps(1)
    session.ask(SetCamera("third_b", CameraState()))
    frame = session.steps(17)
    assert frame.world.outcomes[-1].deeds == (
        Deed("First person", "was dropped", 4),
        Deed("Third A", "sent 70 % noise", 7),
        Deed("Third B", "was broken", None),
    )
    words = ending_of(frame, measured)
    assert words is not None and words.measured.endswith("over 4 episodes: 0.25 [0.05, 0.70].")
    assert session.at(session.time + HOLD_TO_READ - 0.1) is not None
    assert session.frames[-1].world.step == 25, "there is time to read"
    assert ending_of(session.ask(Scrub(3)), measured) is None, "an earlier step is no end"


class Early(ToyReach):
    """Ends before its horizon, as some tasks do at their first success."""

    def step(self, action: Array) -> TimeStep:
        arrived = super().step(action)
        return replace(arrived, success=self._step == 7, last=self._step == 7)


def test_an_episode_that_ends_early_has_ended() -> None:
    session = Recorder(env_factory=lambda _, *options: Early("reach", *options))
    session.steps(3)
    session.ask(SetCamera("first", OFF))
    frame = session.steps(4)
    assert (frame.world.step, frame.pace.phase, frame.ended) == (7, "ended", True)
    assert frame.history[-1].last and not frame.history[-2].last
    words = ending_of(session.frames[-1], measured)
    assert words is not None and words.done == "First person was dropped at step 3."
    alone = Session(lambda _, *options: Early("reach", *options), FakePolicy(), speed=None)
    assert [one.world.step for one in frames(alone, None)] == list(range(8))


def test_a_camera_that_was_moved_says_where_it_stood(session: Recorder) -> None:
    session.ask(MoveCamera("first", Displacement(pan=10)))
    deeds = session.steps(25).world.outcomes[-1].deeds
    assert deeds == (Deed("First person", "stood elsewhere (turned right 10°)", 0),)


def test_an_episode_without_a_change_ends_without_words(session: Recorder) -> None:
    frame = session.steps(25)
    assert ending_of(frame, measured) is None
    session.at(session.time + HOLD)
    assert session.frames[-1].world.step == 0


def test_every_comparison_ends_in_words(session: Recorder) -> None:
    session.ask(Compare("toy-other"))
    frame = session.steps(25)
    words = ending_of(frame, measured)
    assert words is not None and words.done == ""
    assert words.measured == (
        "Over 100 episodes: MAD 0.70 [0.60, 0.78] and Merged Only 0.70 [0.60, 0.78]."
    )
    session.at(session.time + HOLD)
    assert session.frames[-1].ended


def test_at_full_speed_nothing_is_held(session: Recorder) -> None:
    session.ask(SetCamera("first", OFF))
    session.ask(SetSpeed(None))
    for _ in range(26):
        session.at(session.time)
    assert session.frames[-1].world.episode == 2


def test_a_guard_helps_costs_or_is_not_decided() -> None:
    low, high = (f"{100 * end:+.0f}" for end in Paired(1, 19, 0, 0).interval())
    assert guard_words(Paired(1, 19, 0, 0)) == (
        "The guard helps: 1.00 with it, 0.05 without, on the same 20 scenes "
        f"(+95 points [{low}, {high}])."
    )
    assert guard_words(Paired(1, 0, 19, 0)).startswith("The guard costs success: 0.05 with it")
    assert guard_words(Paired(2, 3, 0, 0)) == (
        "With the guard 1.00, without 0.40, on the same 5 scenes: no difference is shown yet."
    )
    assert "on the same 1 scene: no" in guard_words(Paired(1, 0, 0, 0))
    assert guard_words(Paired(0, 0, 0, 0)) == ""
