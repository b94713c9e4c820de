"""What the notebooks share, so that a cell of theirs is a question and a line or two of code.

    episode      its time steps, and how a policy acts at each
    rates        successes in words, with their intervals
    small_runs   trainings that fit into a lesson

All of these are here under ``madviz.teaching``; ``show``, ``lessons``, ``baselines`` and ``inside``
are modules of their own, for those lessons that need them.
"""

from madviz.teaching.episode import (
    LESSON_SEED,
    Moment,
    begin,
    frames_of,
    moment_at,
    moments,
    occluded,
)
from madviz.teaching.rates import (
    counts,
    in_words,
    paired_table,
    shipped,
    shipped_outcomes,
    success_bars,
    success_table,
)
from madviz.teaching.small_runs import SmallRun, train_light, train_small

__all__ = [
    "LESSON_SEED",
    "Moment",
    "SmallRun",
    "begin",
    "counts",
    "frames_of",
    "in_words",
    "moment_at",
    "moments",
    "occluded",
    "paired_table",
    "shipped",
    "shipped_outcomes",
    "success_bars",
    "success_table",
    "train_light",
    "train_small",
]
