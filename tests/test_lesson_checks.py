"""Exercises that check themselves: each on its solution, on an empty answer and on wrong ones."""

from __future__ import annotations

import ast
import runpy
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest

from madviz import teaching
from madviz.errors import UserError
from madviz.teaching import checks
from madviz.teaching.checks import CHECKS, NotYet, judge, lesson_02, table
from madviz.teaching.checks.exercise import HINTS

BUILD = runpy.run_path(str(Path(__file__).parent.parent / "notebooks" / "build.py"))
LESSONS: list[str] = [name for name in BUILD["names"]([]) if checks.of_lesson(name)]
NAMES = list(CHECKS)


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


def answered(name: str, tags: tuple[str, ...]) -> list[Any]:
    """What the cells with ``tags`` above a check give it."""
    lesson = next(lesson for lesson in LESSONS if lesson[:2] == name[:2])
    names = imported(lesson)
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


WRONG: dict[str, dict[str, tuple[Any, ...]]] = {
    "02.merge": {
        "it is not the sum of those cameras": (lambda features, present: features.sum(0),),
        "expected an array of the shape (4,)": (lambda features, present: features[present],),
    },
    "02.mean": {
        "it is not the mean of those cameras": (lambda f, present: present @ f / len(f),),
        "with no camera": (lambda features, present: features[present].mean(0),),
        "it is the sum": (lambda features, present: present @ features,),
    },
}
"""Check -> what is said about answers that students give."""


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
    monkeypatch.setattr(table, "_failed", type(table._failed)())
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
    monkeypatch.setattr(table, "_failed", type(table._failed)())
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
