"""Which episode seeds serve which use, so that nothing is reported that was developed on.

A seed fixes an episode's scene. The uses are apart:

    0 to 999             training with a scripted expert
    1000 to 1999         selection: evaluations while a policy trains; mean pictures
    2000 to 4999         the live page and the lessons
    5000 to 9999         development: recipes, experts and choices were improved on these
    10000 to 999999      reporting: nothing is developed or chosen on them
    1000000 and up       training scenes of reinforcement learning
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable

FIRST_SELECTION = 1_000
"""Training with a scripted expert has all seeds below."""
USES = {
    0: "training",
    FIRST_SELECTION: "selection",
    2_000: "live page",
    5_000: "development",
    10_000: "reporting",
    1_000_000: "reinforcement learning",
}
"""The first seed of each use."""
DEVELOPMENT, REPORTING = "development", "reporting"
FIRST_REPORTING = 10_000
FIRST_LEARNING = 1_000_000


def training_seed(seed: int, number: int) -> int:
    """Of episode ``number``, from 0 on, in a training with a scripted expert whose own seed is
    ``seed``: below ``FIRST_SELECTION``, so a training with more episodes meets scenes again."""
    return (seed * 137 + number) % FIRST_SELECTION


def use_of(seeds: Iterable[int]) -> str:
    """``development``, ``reporting`` or another use of all of ``seeds``; several are joined with
    ``and``."""
    firsts, names = list(USES), list(USES.values())
    places = sorted({bisect_right(firsts, seed) - 1 for seed in seeds})
    return " and ".join(names[place] for place in places)
