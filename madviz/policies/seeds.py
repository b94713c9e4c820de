"""Which episode seeds serve which use, so that nothing is reported that was developed on.

A seed fixes an episode's scene. The uses are apart:

    0 to 999             training with a scripted expert
    1000 to 1999         selection: evaluations while a policy trains; mean pictures
    2000 to 4999         the live page and the lessons
    5000 to 9999         development: recipes, experts and choices were improved on these
    10000 to 39999       development (read): the first reporting range. Some policies were trained
                         again after their rates on it were read, so it counts as development
    40000 to 49999       reporting: read once, after all choices; results/readings.csv lists it.
                         From 45000 on they are for the guard, from 47000 on for recordings
    50000 to 59999       unused
    60000 to 999999      try: where commands begin
    1000000 and up       training scenes of reinforcement learning
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable

from madviz.errors import UserError

FIRST_TRAINING = 0
FIRST_SELECTION = 1_000
FIRST_LIVE = 2_000
FIRST_DEVELOPMENT = 5_000
FIRST_READ = 10_000
FIRST_REPORTING = 40_000
FIRST_GUARD = 45_000
FIRST_UNUSED = 50_000
FIRST_TRY = 60_000
FIRST_LEARNING = 1_000_000
DEVELOPMENT = "development"
READ = "development (read)"
REPORTING = "reporting"
TRY = "try"
USES = {
    FIRST_TRAINING: "training",
    FIRST_SELECTION: "selection",
    FIRST_LIVE: "live page",
    FIRST_DEVELOPMENT: DEVELOPMENT,
    FIRST_READ: READ,
    FIRST_REPORTING: REPORTING,
    FIRST_UNUSED: "unused",
    FIRST_TRY: TRY,
    FIRST_LEARNING: "reinforcement learning",
}
"""The first seed of each use."""
MEASURED = (REPORTING, READ, TRY, DEVELOPMENT)
"""Uses that rates may have; policies are compared on the first of these that all of them have."""


def training_seed(seed: int, number: int) -> int:
    """The seed of episode ``number``, from 0 on, in a training with a scripted expert. The
    training's own seed is ``seed``. The result is below ``FIRST_SELECTION``, so a training with
    more episodes meets scenes again."""
    return (seed * 137 + number) % FIRST_SELECTION


def seeds_from(first: int, count: int) -> range:
    """``count`` seeds of the use that begins at ``first``. Raises UserError if it has fewer."""
    seeds = range(first, first + count)
    end = min((start for start in USES if start > first), default=seeds.stop)
    if seeds.stop > end:
        raise UserError(
            f"expected {end - first} episodes or fewer, one for each seed from {first} to "
            f"{end - 1} ({USES[first]}), found {count}; those above serve another use"
        )
    return seeds


def use_of(seeds: Iterable[int]) -> str:
    """``development``, ``reporting`` or another use of all of ``seeds``; several are joined with
    ``and``."""
    firsts = list(USES)
    names = list(USES.values())
    places = sorted({bisect_right(firsts, seed) - 1 for seed in seeds})
    return " and ".join(names[place] for place in places)
