"""The table of a policy's episodes: what is played, what is kept, and where."""

import numpy as np
import pytest

from madviz.envs.registry import SETTINGS
from madviz.measure import table as table_module
from madviz.measure.store import MEMORY, EpisodeResult, Store
from madviz.measure.table import Table
from madviz.observation.ablation import Occlusion
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement
from madviz.subsets import every_mask, name_of
from tests.fakes import FakePolicy

ALL, BLACK = Condition("all"), Condition("all", (("first", Occlusion("black")),))
MINE = "tests.fakes:FakePolicy"


@pytest.fixture
def played(monkeypatch):
    """The jobs that were played, none of them in a simulator."""
    jobs = []

    def play(asked, workers, here, progress):
        for job in asked:
            jobs.append((job.condition, job.seed))
            yield job, (EpisodeResult(job.condition.subset, job.seed, True, True, 1.0), "near")

    monkeypatch.setattr(table_module, "run_anywhere", play)
    return jobs


def test_only_what_is_missing_is_played_and_each_episode_once(played):
    table, _ = Table.opened(FakePolicy())
    table.play([(ALL, 1), (ALL, 2), (ALL, 1)], workers=0)
    assert played == [(ALL, 1), (ALL, 2)] and table.definition == "near"
    table.play([(ALL, 2), (BLACK, 2), (ALL, 3)], workers=0)
    assert played[2:] == [(BLACK, 2), (ALL, 3)]
    assert table.outcomes(ALL) == {1: True, 2: True, 3: True}


def test_its_own_store_keeps_episodes_of_a_users_own_code_and_a_shared_one_does_not(played):
    for own, again in ((True, 0), (False, 2)):
        store = Store(MEMORY)
        for _ in range(2):
            table, _ = Table.opened(MINE, store, own=own)
            played.clear()
            table.play([(ALL, 1), (BLACK, 1)], workers=0)
        assert len(played) == again


def test_a_condition_and_the_switches_that_give_it_are_one_and_the_same():
    moved = (("third_a", Displacement(right=0.1)),)
    for setting in ("three", "three-rgbd"):
        streams = SETTINGS[setting].streams
        for mask in every_mask(len(streams)):
            condition = Condition(name_of(mask, streams), BLACK.occlusions, moved)
            ablation = condition.ablation(streams)
            assert np.array_equal(ablation.mask(streams), mask)
            assert Condition.of(ablation, streams) == condition.noticed(streams)
            assert condition.noticed(streams).noticed(streams) == condition.noticed(streams)
