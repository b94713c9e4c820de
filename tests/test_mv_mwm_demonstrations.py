"""The recipe mv-mwm with demonstrations, and what its card says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from madviz.errors import UserError
from madviz.policies.card import card_text
from madviz.policies.config import read_config
from madviz.runs import reward_run
from madviz.runs.demonstrations import Dataset
from madviz.runs.training_plan import TrainingPlan
from madviz.world_model import recipe
from madviz.world_model.mv_mwm_options import MvMwmConfig
from madviz.world_model.recipe import unlike
from tests.recipe_runs import assert_same_run, stops_at
from tests.test_mv_mwm_run import SHORT, TINY, run


def test_a_run_with_demonstrations_goes_on_with_the_same_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = replace(TINY, demonstrations=2, steps=64, update_ratio=0.2)
    whole = run(tmp_path / "whole", config)
    assert whole["losses"]["cloning_loss"] > 0

    monkeypatch.setattr(reward_run, "PROGRESS_SECONDS", 0)
    stopped = run(tmp_path / "run", config, listener=stops_at(54))
    assert stopped["step"] == 54 and stopped["updates"] < whole["updates"]
    assert_same_run(run(tmp_path / "run", config, resume=True), whole)
    card = card_text(tmp_path / "run")
    assert "imitation of 2 episodes of a scripted expert" in card
    assert "expert demonstrations: 2" in card
    told = read_config(tmp_path / "run" / "config.json")[0].training
    assert told.environment_steps == 64 + 2 * 25, "those of the demonstrations count"
    assert told.seeds == "network and data 3, episodes from 1000000 on, demonstrations below 1000"


@pytest.mark.parametrize("size", [2, 3])
def test_a_small_batch_has_a_demonstration_of_the_expert_alone(
    size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, kept = recipe.recorded, []

    def recorded(plan: TrainingPlan, count: int) -> Dataset:
        kept.append(plain(plan, count))
        return kept[0]

    monkeypatch.setattr(recipe, "recorded", recorded)
    state = run(tmp_path, replace(SHORT, demonstrations=1, batch_size=size, update_ratio=0.5))
    assert np.isfinite(list(state["losses"].values())).all() and state["losses"]["cloning_loss"] > 0
    data, every = kept[0], np.arange(25)
    done, asked_for = data.column("actions", every), data.column("labels", every)
    assert np.array_equal(done, asked_for), "without noise"


def test_a_batch_of_one_has_no_room_for_a_demonstration(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--mv-mwm.batch-size of 2 or more.*found 1; raise it"):
        run(tmp_path / "run", replace(TINY, demonstrations=1, batch_size=1))
    assert not (tmp_path / "run").exists()


def test_the_card_says_what_moves_is_weighted_where_it_is() -> None:
    configs = (MvMwmConfig(size="tiny"), MvMwmConfig(size="small"), MvMwmConfig(size="paper"))
    assert ["weights what moves" in unlike(each) for each in configs] == [True, True, False]
