"""Exercises that check themselves: each on its solution, on an empty answer and on wrong ones."""

from __future__ import annotations

import ast
import runpy
from itertools import permutations
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest

from madviz import teaching
from madviz.errors import UserError
from madviz.measure.statistics import Paired
from madviz.subsets import mask_of, name_of
from madviz.teaching import checks
from madviz.teaching.checks import CHECKS, NotYet, check_table, judge, lesson_02
from madviz.teaching.checks.exercise import HINTS
from madviz.teaching.outcomes import one_missing, read_outcomes

BUILD = runpy.run_path(str(Path(__file__).parent.parent / "notebooks" / "build.py"))
LESSONS: list[str] = [name for name in BUILD["names"]([]) if checks.of_lesson(name)]
NAMES = list(CHECKS)
MERGED_ONLY = "metaworld-hammer-merged-only-light"


def tagged(lesson: str, *tags: str) -> list[nbformat.NotebookNode]:
    """The cells of a lesson that have one of these tags."""
    cells = BUILD["from_text"](lesson).cells
    return [cell for cell in cells if set(tags) & set(cell.metadata.get("tags", []))]


def imported(lesson: str) -> dict[str, Any]:
    """What the first cell of a lesson imports."""
    cells = [cell for cell in BUILD["from_text"](lesson).cells if cell.cell_type == "code"]
    body = ast.parse(cells[0].source).body
    first: list[ast.stmt] = [n for n in body if isinstance(n, ast.Import | ast.ImportFrom)]
    names: dict[str, Any] = {}
    exec(compile(ast.Module(first, []), "imports", "exec"), names)
    return names


class OneTimeStep:
    """As large as one of lesson 1."""

    stack, state = np.zeros((3, 9, 84, 84), np.uint8), np.zeros(24)


def hammer_rate(cameras: Any) -> float:
    """Success of merged-only, as lesson 8 has it."""
    streams = ("first", "third_a", "third_b")
    name = name_of(mask_of("+".join(cameras) or "none", streams), streams)
    successes, n = teaching.shipped(MERGED_ONLY)[name]
    return successes / n


ABOVE: dict[str, dict[str, Any]] = {
    "00": {"MERGED_ONLY": lambda: MERGED_ONLY},
    "01": {"now": OneTimeStep},
    "06": {"best": lambda: one_missing(read_outcomes())},
    "08": {"streams": lambda: ("first", "third_a", "third_b"), "rate": lambda: hammer_rate},
}
"""Lesson -> names that its solutions have from the cells above, and what makes them."""


def answered(name: str, tags: tuple[str, ...]) -> list[Any]:
    """What the cells with ``tags`` above a check give it."""
    lesson = next(lesson for lesson in LESSONS if lesson[:2] == name[:2])
    names = imported(lesson) | {name: value() for name, value in ABOVE.get(name[:2], {}).items()}
    for cell in tagged(lesson, "check", *tags):
        if cell.source == CHECKS[name].cell:
            return [names[each] for each in CHECKS[name].takes]
        if cell.cell_type == "code" and "check" not in cell.metadata.tags:
            exec(cell.source, names)
    raise AssertionError(f"the lesson has no cell {CHECKS[name].cell}")


@pytest.mark.parametrize("lesson", LESSONS)
def test_a_lesson_has_its_checks_and_an_answer_to_write_above_each(lesson: str) -> None:
    cells = tagged(lesson, "answer", "solution", "check")
    assert [c.source for c in cells if "check" in c.metadata.tags] == [
        check.cell for check in checks.of_lesson(lesson)
    ]
    for index, cell in enumerate(cells):
        if "check" in cell.metadata.tags:
            above = [c.metadata.tags for c in cells[index - 2 : index]]
            assert above == [["answer"], ["solution"]], cell.source


@pytest.mark.parametrize("name", NAMES)
def test_the_solution_is_right(name: str) -> None:
    assert judge(name, *answered(name, ("answer", "solution"))) == checks.Result(name, True)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_handed_out_is_empty(name: str) -> None:
    result = judge(name, *answered(name, ("answer",)))
    assert result.empty and not result.passed and CHECKS[name].asks in result.missing


def nothing(*given: Any) -> Any:
    """A function that raises nothing and answers something."""
    return 0.0


def in_place(stack: Any, streams: Any) -> Any:
    """The right rows, in the stack that was given."""
    stack[[name.endswith(".rgb") for name in streams]] = 0
    return stack


def zero_without_cameras(rate: Any, camera: Any, cameras: Any) -> Any:
    """The Shapley value, if the success without any camera were 0."""
    before = [order[: order.index(camera)] for order in permutations(cameras)]
    return np.mean([rate([*each, camera]) - (rate(each) if each else 0) for each in before])


def half_open(expected: Any, interval: Any) -> str:
    """A verdict that leaves out the upper end of what is expected."""
    (low, high), (least, most) = expected, interval
    if low <= least and most < high:
        return "as planned"
    return "not as planned" if most < low or high < least else "cannot say"


PLAN: dict[str, Any] = {
    "question": "Does it need the camera only until then?",
    "conditions": {"never": None, "early": 10, "late": 60},
    "episodes": 8,
    "first_seed": 2000,
    "expect": {"never": (0.6, 1.0), "early": (0.0, 0.4), "late": (0.6, 1.0)},
    "wrong_if": "late loses half of the successes",
}
WRONG: dict[str, dict[str, tuple[Any, ...]]] = {
    "00.rates": {
        "have changed places": (0.0, 1.0),
        "First person alone": (1.00, 0.03),
        "from 0 to 1": (100, 0),
        "not the rates": (0.5, 0.5),
    },
    "00.link": {
        "off leaves the sum": (f"#policy={MERGED_ONLY}&third_a=off@20",),
        "another camera": (f"#policy={MERGED_ONLY}&first=black@20",),
        "at step 0": (f"#policy={MERGED_ONLY}&third_a=black",),
        "not Merged Only": ("#policy=metaworld-hammer-mad-light&third_a=black@20",),
        "no camera is switched": (f"#policy={MERGED_ONLY}",),
        "more than one thing": (f"#policy={MERGED_ONLY}&third_a=off@10&third_a=black@20",),
        "on side B": (f"#policy={MERGED_ONLY}&b.third_a=black@20",),
        "something else than black": (f"#policy={MERGED_ONLY}&third_a=both:noise:0.5@20",),
        "else than black": (f"#policy={MERGED_ONLY}&third_a=noise:black@20",),
        "Third A sends something": (f"#policy={MERGED_ONLY}&third_a=depth:black@20",),
        "than black": (f"#policy={MERGED_ONLY}&third_a=black:9@20",),
        "no number": (f"#policy={MERGED_ONLY}&third_a=black@20&seed=abc",),
    },
    "01.numbers": {
        "these are the pictures alone": (3 * 9 * 84 * 84,),
        "one camera, or one frame": (9 * 84 * 84 + 24,),
        "expected a whole number": ("many",),
    },
    "01.still": {
        "the oldest picture": (lambda stack: np.tile(stack[:, :3], (1, 3, 1, 1)),),
        "out of order": (lambda stack: np.repeat(stack[:, -3:], 3, axis=1),),
        "nothing has changed": (lambda stack: stack,),
        "expected the shape": (lambda stack: stack[:, -3:],),
    },
    "02.merge": {
        "it is not the sum of those cameras": (lambda features, present: features.sum(0),),
        "expected an array of the shape (4,)": (lambda features, present: features[present],),
        "zeros: expected an array": (lambda features, present: sum(features[present]),),
        "is a `return` missing?": (lambda features, present: None,),
    },
    "02.mean": {
        "it is not the mean of those cameras": (lambda f, present: present @ f / len(f),),
        "with no camera": (lambda features, present: features[present].mean(0),),
        "it is the sum": (lambda features, present: present @ features,),
    },
    "03.loss": {
        "have changed places": (lambda m, s, alpha: (1 - alpha) * m + alpha * s.mean(),),
        "not their mean": (lambda m, s, alpha: alpha * m + (1 - alpha) * s.sum(),),
        "with two cameras": (lambda m, s, alpha: alpha * m + (1 - alpha) * s.sum() / 3,),
        "it has to be the merged loss": (lambda m, s, alpha: (m + s.sum()) / 4,),
    },
    "03.weights": {
        "add up to 3": ([0, 1, 1, 1],),
        "never reads the sum": ([1, 0, 0, 0],),
        "expected four numbers": ([1 / 3, 1 / 3, 1 / 3],),
    },
    "04.paired": {
        "in best A does not solve 9": (Paired(7, 0, 2, 1), Paired(6, 3, 1, 0)),
        "best: B still solves": (Paired(6, 3, 1, 0), Paired(7, 2, 0, 1)),
        "the same case": (Paired(7, 2, 0, 1), Paired(7, 2, 0, 1)),
        "best has 9 episodes": (Paired(7, 2, 0, 0), Paired(6, 3, 1, 0)),
        "worst has fewer than 0": (Paired(7, 2, 0, 1), Paired(5, 4, 2, -1)),
    },
    "04.episodes": {"p is 0.12": (20,), "fewer are enough": (100,), "not a multiple": (25,)},
    "04.frozen": {
        "misses a camera": (lambda picture, before, state, state_before: False,),
        "one pixel": (lambda picture, before, *_: abs(int(picture.sum()) - int(before.sum())) < 9,),
        "one pixel of the picture": (
            lambda picture, before, *_: np.array_equal(picture[..., 1], before[..., 1]),
        ),
        "changed places": (lambda picture, before, *_: picture.sum() == before.sum(),),
        "expected True or False": (lambda picture, before, *_: picture == before,),
        "expected a function": (True,),
    },
    "04.mended": {
        "stands still": (lambda picture, before, *_: np.array_equal(picture, before),),
        "one pixel": (lambda picture, before, now, then: not np.allclose(now, then),),
        "by 1 cm along x alone": (
            lambda p, b, now, then: np.array_equal(p, b) and (now != then).all(),
        ),
    },
    "05.sets": {"the empty set": (8,), "the single streams": (3,), "is not their number": (32,)},
    "05.dark": {
        "it changes the stack": (in_place,),
        "first.depth has changed": (lambda stack, streams: stack * 0,),
        "first.rgb is not black": (lambda stack, streams: stack,),
        "expected the shape": (lambda stack, streams: stack[1::2],),
    },
    "06.lost": {
        "a number of episodes": (lambda before, after: before.count("1") - after.count("1"),),
        "the sign is reversed": (lambda b, a: (a.count("1") - b.count("1")) / len(b),),
        "loses less than nothing": (lambda b, a: max(0, b.count("1") - a.count("1")) / len(b),),
        "for ten episodes": (lambda before, after: (before.count("1") - after.count("1")) / 4,),
    },
    "06.sturdy": {
        "a method is missing": (["mad"],),
        "one of these fails": (["mad", "mvd", "concat"],),
        "`single` has no First person": (["mad", "mvd", "single"],),
        "found one name": ("mad",),
        "found MAD": (["MAD", "mvd"],),
    },
    "07.mean_action": {
        "it is the mean of the squashed": (lambda actions, present: actions[present].mean(0),),
        "the missing cameras": (lambda actions, present: np.tanh(np.arctanh(actions).mean(0)),),
    },
    "07.shares": {
        "the shares add up to 0": (lambda s, present: np.exp(s) / np.exp(s).sum() * present,),
        "are not softmax": (lambda scores, present: present / present.sum(),),
        "a missing camera has a share": (lambda s, present: np.exp(s) / np.exp(s).sum(),),
    },
    "08.shapley": {
        "all minus the rate without": (
            lambda rate, one, cameras: rate(cameras) - rate([c for c in cameras if c != one]),
        ),
        "of it alone": (lambda rate, camera, cameras: rate([camera]) - rate([]),),
        "not the mean over all orders": (lambda rate, camera, cameras: rate(cameras) / 3,),
        "for 'a' of 'abc' it is not the mean": (zero_without_cameras,),
    },
    "08.spared": {
        "without First person": ("first",),
        "about a sixth": ("third_a",),
        "expected one of": ("Third B",),
    },
    "09.plan": {
        "the plan has no wrong_if": ({k: v for k, v in PLAN.items() if k != "wrong_if"},),
        "with what will you compare": (PLAN | {"conditions": {"early": 10, "late": 60}},),
        "nearly any result agrees": (PLAN | {"expect": dict.fromkeys(PLAN["expect"], (0, 1))},),
        "take too long": (PLAN | {"episodes": 100},),
        "seeds of the live page": (PLAN | {"first_seed": 10_000},),
        "seeds of the live page are 2000": (PLAN | {"first_seed": 4_999},),
        "a whole number for episodes, found 8.0": (PLAN | {"episodes": 24 / 3},),
        "nothing is written for episodes": (PLAN | {"episodes": ...},),
        "has to be a sentence": (PLAN | {"wrong_if": "never"},),
        "two different steps": (PLAN | {"conditions": {"never": None, "early": 10}},),
        "you expect the same": (PLAN | {"expect": dict.fromkeys(PLAN["expect"], (0.5, 1))},),
    },
    "09.verdict": {
        "is not right": (lambda expected, interval: "as planned",),
        "expected one of as planned": (lambda expected, interval: True,),
        "measured [0.68, 1.0]: 'cannot say' is not right": (half_open,),
    },
}
"""Check -> what is said about answers that students give."""


@pytest.mark.parametrize(
    ("name", "answer"),
    [
        ("00.link", f"#policy={MERGED_ONLY}&vs=metaworld-hammer-mad-light&third_a=black@20"),
        ("00.link", f"#policy={MERGED_ONLY}&seed=5000&guard=on&a.third_a=both:black@20"),
        ("00.link", f"#policy={MERGED_ONLY}&third_a=black:0.5@020"),
        ("09.plan", PLAN | {"first_seed": 3_500}),
    ],
)
def test_another_right_answer_is_right(name: str, answer: Any) -> None:
    assert judge(name, answer) == checks.Result(name, True)


def test_every_check_knows_two_typical_mistakes() -> None:
    assert WRONG.keys() == CHECKS.keys()
    assert all(len(answers) >= 2 for answers in WRONG.values())


@pytest.mark.filterwarnings("ignore:Mean of empty slice", "ignore:invalid value")
@pytest.mark.parametrize(
    ("name", "said", "answers"),
    [(name, said, given) for name, one in WRONG.items() for said, given in one.items()],
)
def test_a_typical_mistake_is_named(name: str, said: str, answers: tuple[Any, ...]) -> None:
    result = judge(name, *answers)
    assert not result.passed and not result.empty and not result.error
    assert said in result.missing


@pytest.mark.parametrize("name", NAMES)
def test_hints_come_in_steps_and_are_not_the_answer(name: str) -> None:
    check = CHECKS[name]
    assert len(check.hints) == HINTS and all(hint[-1] in ".?" for hint in check.hints)
    lesson = next(lesson for lesson in LESSONS if lesson[:2] == name[:2])
    lines = {line.strip() for cell in tagged(lesson, "solution") if cell.cell_type == "code"
             for line in cell.source.splitlines() if "=" in line or "return" in line}  # fmt: skip
    said = " ".join((check.asks, *check.hints))
    assert not [line for line in lines if line in said]


def test_the_next_hint_is_shown_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check_table, "_failed", type(check_table._failed)())
    seen = []
    for _ in range(4):
        with pytest.raises(NotYet) as raised:
            teaching.check("02.mean", ...)
        seen.append(len(raised.value.result.hints))
    assert seen == [1, 2, 3, 3]
    assert raised.value._render_traceback_()[1].startswith("Hint 1 of 3: ")
    assert "\n" not in str(raised.value) and "02.mean: nothing is answered yet" in str(raised.value)
    right = teaching.check("02.mean", *answered("02.mean", ("solution",)))
    assert repr(right) == "02.mean: right" and len(right.hints) == 3


def test_hints_can_be_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check_table, "_failed", type(check_table._failed)())
    with pytest.raises(NotYet) as raised:
        teaching.check("02.merge", nothing, hint=2)
    assert len(raised.value.result.hints) == 2


def test_whatever_an_answer_does_there_is_a_result() -> None:
    def breaks(features: Any, present: Any) -> None:
        raise ZeroDivisionError("by\nzero")

    result = judge("02.mean", breaks)
    assert result.error == "ZeroDivisionError: by\\nzero" and "the code stopped" in result.missing
    assert "expected a function, found 3" in judge("02.mean", 3).missing
    assert "TypeError" in judge("02.mean", lambda: 1).error
    with pytest.raises(UserError, match="expected teaching.check"):
        judge("02.mean")
    with pytest.raises(UserError, match="did you mean 02.mean"):
        judge("02.men")


def test_an_answer_cannot_spoil_the_data_of_a_check() -> None:
    def spoils(features: Any, present: Any) -> Any:
        features[:] = 0
        return features.sum(0)

    assert not judge("02.merge", spoils).passed
    assert judge("02.merge", lambda features, present: present @ features).passed
    assert np.any(lesson_02.FEATURES)
