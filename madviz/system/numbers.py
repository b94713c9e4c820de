"""The range of every number that a command takes: said once, in the type of the option.

episodes: Count = 50        --episodes: expected a whole number from 1 to 1000000, found 0
"""

from __future__ import annotations

from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from madviz.errors import UserError
from madviz.system.options import notes, options


class Range(PrimitiveConstructorSpec[Any]):
    """A number from ``low`` to ``high``, both included."""

    def __init__(self, kind: type, low: float, high: float, above: bool = False) -> None:
        """``kind`` is int or float. ``above``: ``low`` itself is outside."""
        super().__init__(
            nargs=1,
            metavar=kind.__name__.upper(),
            instance_from_str=self._read,
            is_instance=lambda value: isinstance(value, int | float),
            str_from_instance=lambda value: [str(value)],
        )
        vars(self).update(kind=kind, low=low, high=high, above=above)

    kind: type
    low: float
    high: float
    above: bool

    def holds(self, value: float) -> bool:
        """Whether ``value`` is inside; NaN is in no range."""
        return self.low <= value <= self.high and not (self.above and value == self.low)

    def refusal(self, found: object) -> str:
        """``expected a whole number from 1 to 256, found 0``."""
        name = "a whole number" if self.kind is int else "a number"
        low = f"above {self.low}, up to" if self.above else f"from {self.low} to"
        return f"expected {name} {low} {self.high}, found {found!s:.60}"

    def takes(self, word: str) -> bool:
        """Whether ``word`` says a number that is inside."""
        try:
            return self.holds(self.kind(word))
        except ValueError:
            return False

    def _read(self, words: list[str]) -> Any:
        if not self.takes(words[0]):
            raise ValueError(self.refusal(words[0]))
        return self.kind(words[0])


Count = Annotated[int, Range(int, 1, 1_000_000)]
CountOrNone = Annotated[int, Range(int, 0, 1_000_000)]
Steps = Annotated[int, Range(int, 1, 1_000_000_000)]
Seed = Annotated[int, Range(int, 0, 2**31 - 1)]
Threads = Annotated[int, Range(int, 1, 256)]
ThreadsOrNone = Annotated[int, Range(int, 0, 256)]
"""Also processes."""
Width = Annotated[int, Range(int, 1, 65_536)]
"""Numbers in a layer, or samples in a batch."""
Pixels = Annotated[int, Range(int, 1, 4096)]
Shift = Annotated[int, Range(int, 0, 83)]
"""Pixels that a picture of 84 is moved by; some of it must stay."""
Port = Annotated[int, Range(int, 0, 65_535)]
Share = Annotated[float, Range(float, 0, 1)]
Weight = Annotated[float, Range(float, 0, 1_000_000)]
Rate = Annotated[float, Range(float, 0, 1000, above=True)]
"""A learning rate, or how often a second."""
Time = Annotated[float, Range(float, 0, 1_000_000, above=True)]
"""Seconds or minutes."""


def check_numbers(config: Any) -> None:
    """Raises UserError for a number in ``config``, a dataclass, that is not in its range."""
    for option, kind, value in options(config):
        for allowed in notes(kind, Range):
            for number in value if isinstance(value, tuple) else (value,):
                if number is not None and not allowed.holds(number):
                    raise UserError(f"{option}: {allowed.refusal(number)}")
