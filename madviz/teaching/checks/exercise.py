"""An exercise, its result, and what the functions in ``lesson_NN.py`` say with."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np

from madviz.errors import UserError, printable
from madviz.subsets import every_mask
from madviz.types import Array

Judge = Callable[..., None]


class Missing(Exception):
    """The missing part of an answer, in a sentence for the student."""


class Blank(Missing):
    """Nothing was answered yet."""


@dataclass(frozen=True)
class Result:
    """The result of a check."""

    name: str
    passed: bool
    missing: str = ""
    """The missing or wrong part, in plain words; '' where the answer is right."""
    empty: bool = False
    """Whether nothing was answered yet."""
    error: str = ""
    """The error that the student's code raised, in one line; '' where it raised nothing."""
    hints: tuple[str, ...] = ()
    """Those that the student has seen by now, and ``judge`` gives none."""

    def __repr__(self) -> str:
        return f"{self.name}: right" if self.passed else "\n".join(self.lines)

    @property
    def lines(self) -> list[str]:
        """The lines that a failed check shows."""
        words = [f"{self.name}: {self.missing}"]
        return words + [f"Hint {i} of {HINTS}: {hint}" for i, hint in enumerate(self.hints, 1)]


HINTS = 3
"""The number of hints of every check."""


class NotYet(UserError):
    """An exercise whose answer is missing or wrong. A notebook shows its lines and no traceback."""

    def __init__(self, result: Result) -> None:
        super().__init__("  ".join(result.lines))
        self.result = result

    def _render_traceback_(self) -> list[str]:
        return self.result.lines


@dataclass(frozen=True)
class Exercise:
    """One exercise: what is asked, how an answer is judged, and how a student is helped."""

    name: str
    asks: str
    """The task, in a few words."""
    hints: tuple[str, ...]
    judge: Judge
    """Takes the answers; raises Missing. Its parameters are the names in the notebook."""

    @property
    def takes(self) -> tuple[str, ...]:
        """Names in the notebook that hold the answers."""
        return tuple(inspect.signature(self.judge).parameters)

    @property
    def cell(self) -> str:
        """The text of its cell in the notebook."""
        return f'teaching.check("{self.name}", {", ".join(self.takes)})'

    def of(self, answers: Sequence[Any]) -> Result:
        """Judges answers, in the order of ``takes``. Whatever they do, there is a result. Raises
        UserError where there are more or fewer of them."""
        if len(answers) != len(self.takes):
            raise UserError(f"expected {self.cell}, found {len(answers)} answers; run that line")
        try:
            if any(blank(answer) for answer in answers):
                raise Blank
            self.judge(*answers)
        except Blank:
            return Result(self.name, False, f"nothing is answered yet: {self.asks}", empty=True)
        except Missing as missing:
            return Result(self.name, False, printable(str(missing)))
        except Exception as error:  # Whatever a student's code may raise.
            found = printable(f"{type(error).__name__}: {error}")
            return Result(self.name, False, f"the code stopped with {found}", error=found)
        return Result(self.name, True)


def exercise(name: str, asks: str, *hints: str) -> Callable[[Judge], Exercise]:
    """Makes an exercise of a function; ``hints`` go from a question to nearly a plan."""

    def made(judge: Judge) -> Exercise:
        return Exercise(name, asks, hints, judge)

    return made


# What the functions say.


def blank(answer: Any) -> bool:
    """Whether it is what an answer cell is handed out with."""
    return answer is None or answer is Ellipsis or isinstance(answer, str) and not answer.strip()


def call(function: Any, *given: Any) -> Any:
    """The result of a student's function for copies of ``given``."""
    if not callable(function):
        raise Missing(f"expected a function, found {function!r:.60}")
    found = function(*deepcopy(given))
    expect(found is not None, "the function returned nothing here; is a `return` missing?")
    if blank(found):
        raise Blank
    return found


def expect(condition: Any, words: str) -> None:
    """Says ``words`` where the condition does not hold."""
    if not condition:
        raise Missing(words)


def same(found: Any, expected: Array, words: str) -> None:
    """Says ``words`` where ``found`` has other numbers; its shape, too, where that differs."""
    array = np.asarray(found, float)
    shapes = f"expected an array of the shape {expected.shape}, found {array.shape}"
    expect(array.shape == expected.shape, f"{words}: {shapes}")
    expect(np.allclose(array, expected, atol=1e-5), words)


def some_cameras() -> Iterator[tuple[Array, str]]:
    """(3,) bool, every set of three cameras but the empty one, and the words for it."""
    for present in every_mask(3)[:-1]:
        yield present, f"with present = {present.tolist()}"


def number(found: Any, words: str = "a number") -> float:
    """A student's number. Says what was expected where it is none."""
    ok = isinstance(found, int | float | np.number) and not isinstance(found, bool)
    expect(ok, f"expected {words}, found {found!r:.60}")
    return float(found)
