"""All checks by name, and the two ways to run one: in a notebook, and from a program."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from importlib import import_module
from typing import Any

from madviz.errors import unknown
from madviz.teaching.checks.exercise import Exercise, NotYet, Result

LESSONS = range(10)
CHECKS: dict[str, Exercise] = {
    check.name: check
    for number in LESSONS
    for check in vars(import_module(f"madviz.teaching.checks.lesson_{number:02}")).values()
    if isinstance(check, Exercise)
}
"""In the order of the lessons."""

_failed: Counter[str] = Counter()
"""How often each check has failed in this kernel: so many hints are shown."""


def of_lesson(name: str) -> list[Exercise]:
    """The checks of a lesson, in the order of its cells: of ``02_merge``, or of ``02``."""
    return [check for check in CHECKS.values() if check.name.startswith(f"{name[:2]}.")]


def judge(name: str, *answers: Any) -> Result:
    """The verdict of a check on answers, without hints. Raises UserError for unknown names."""
    if name not in CHECKS:
        raise unknown("check", name, list(CHECKS))
    return CHECKS[name].of(answers)


def check(name: str, *answers: Any, hint: int = 0) -> Result:
    """The same in a notebook. Raises NotYet where an answer is missing or wrong, with one hint more
    each time; ``hint`` shows so many at once. Raises UserError for unknown names."""
    result = judge(name, *answers)
    if not result.passed:
        _failed[name] = max(_failed[name] + 1, hint)
    shown = replace(result, hints=CHECKS[name].hints[: _failed[name]])
    if not result.passed:
        raise NotYet(shown)
    return shown
