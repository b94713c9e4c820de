"""The range of every number that a command takes: said once, in the type of the option.

episodes: Count = 50        --episodes: expected a whole number from 1 to 1000000, found 0
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin

from madviz.errors import UserError
from madviz.system.options import bare, given, notes, options


@dataclass(frozen=True)
class Range:
    """From ``low`` to ``high``, both included."""

    low: float
    high: float
    above: bool = False
    """``low`` itself is outside."""

    def holds(self, value: float) -> bool:
        """NaN is in no range."""
        return self.low <= value <= self.high and not (self.above and value == self.low)

    def in_words(self, kind: type) -> str:
        """``a whole number from 1 to 256``, ``a number above 0, up to 1000``."""
        named = "a whole number" if kind is int else "a number"
        low = f"above {self.low}, up to" if self.above else f"from {self.low} to"
        return f"{named} {low} {self.high}"


Count = Annotated[int, Range(1, 1_000_000)]
CountOrNone = Annotated[int, Range(0, 1_000_000)]
Steps = Annotated[int, Range(1, 1_000_000_000)]
StepsOrNone = Annotated[int, Range(0, 1_000_000_000)]
Seed = Annotated[int, Range(0, 2**31 - 1)]
Threads = Annotated[int, Range(1, 256)]
ThreadsOrNone = Annotated[int, Range(0, 256)]
"""Also processes."""
Width = Annotated[int, Range(1, 65_536)]
"""Numbers in a layer, or samples in a batch."""
Pixels = Annotated[int, Range(1, 4096)]
Shift = Annotated[int, Range(0, 83)]
"""Pixels that a picture of 84 is moved by; some of it must stay."""
Port = Annotated[int, Range(0, 65_535)]
Share = Annotated[float, Range(0, 1)]
Weight = Annotated[float, Range(0, 1_000_000)]
Rate = Annotated[float, Range(0, 1000, above=True)]
"""Of learning, or a second."""
Distance = Annotated[float, Range(-90, 90)]
"""Metres or degrees that a camera goes, or its zoom."""
Time = Annotated[float, Range(0, 1_000_000, above=True)]
"""Seconds or minutes."""


def ranges(config: type) -> Iterator[tuple[str, type, Range | None]]:
    """Every number that ``config``, a dataclass, has: option, int or float, range."""
    for option, kind in options(config):
        choices = (kind,) if get_origin(kind) is Annotated else (kind, *get_args(kind))
        for choice in choices:
            if bare(choice) in (int, float):
                yield option, bare(choice), next(notes(choice, Range), None)


def check_numbers(config: Any) -> None:
    """Raises UserError for a number in ``config``, a dataclass, that is not in its range."""
    for option, kind, allowed in ranges(type(config)):
        value = config
        for name in option.removeprefix("--").split("."):
            value = getattr(value, name.replace("-", "_"))
        for each in value if isinstance(value, tuple) else (value,):
            if allowed is not None and each is not None and not allowed.holds(each):
                raise UserError(f"{option}: expected {allowed.in_words(kind)}, found {each}")


def check_words(config: type, words: Sequence[str]) -> None:
    """Raises UserError for a number among the ``words`` of a command that is none, or is not in
    its range. ``config`` is the dataclass that they fill."""
    known = {option: (kind, allowed) for option, kind, allowed in ranges(config)}
    for option, text in given(words):
        kind, allowed = known.get(option, (None, None))
        if kind is None or allowed is None or text in ("", "None"):
            continue
        try:
            fits = allowed.holds(kind(text))
        except ValueError:
            fits = False
        if not fits:
            raise UserError(f"{option}: expected {allowed.in_words(kind)}, found {text:.60}")
