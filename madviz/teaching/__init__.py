"""The base of the notebooks: episodes, figures, small trainings, exercises that check themselves.

    episode      its time steps, and how a policy acts at each
    rates        successes in words, with their intervals
    checks       exercises that check themselves
    small_runs   trainings that fit into a lesson

All of these are here under ``madviz.teaching``; ``show``, ``lessons``, ``outcomes``, ``baselines``,
``merges`` and ``inside`` are modules of their own, for those lessons that need them.
"""

from madviz.teaching.checks import check as check
from madviz.teaching.counted import counts as counts
from madviz.teaching.counted import in_words as in_words
from madviz.teaching.counted import paired_table as paired_table
from madviz.teaching.counted import shipped as shipped
from madviz.teaching.counted import shipped_outcomes as shipped_outcomes
from madviz.teaching.counted import success_bars as success_bars
from madviz.teaching.counted import success_table as success_table
from madviz.teaching.episode import LESSON_SEED as LESSON_SEED
from madviz.teaching.episode import Moment as Moment
from madviz.teaching.episode import begin as begin
from madviz.teaching.episode import frames_of as frames_of
from madviz.teaching.episode import moment_at as moment_at
from madviz.teaching.episode import moments as moments
from madviz.teaching.episode import occluded as occluded
from madviz.teaching.names import named as named
from madviz.teaching.small_runs import SmallRun as SmallRun
from madviz.teaching.small_runs import train_light as train_light
from madviz.teaching.small_runs import train_small as train_small
