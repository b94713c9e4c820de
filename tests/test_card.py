"""Cards say what the JSON files say, and nothing about other weights."""

import msgspec
import pytest

from madviz.errors import UserError
from madviz.policies.card import card_text, write_card
from madviz.policies.checkpoint import describe, save_policy
from madviz.policies.config import TrainingRecord
from tests.checkpoints import make_agent, make_config, measure


@pytest.fixture
def folder(tmp_path):
    training = TrainingRecord(command="madviz train --task toy/reach", wall_time_s=571.25)
    versions = {"torch": "2.15.0"}
    config = make_config(training=msgspec.structs.replace(training, versions=versions))
    return save_policy(tmp_path / "toy-reach-mad-light", make_agent(), config)


ROWS = {
    "all": {"success": 0.96, "success_any": 1.0, "n": 50, "ci95": [0.8654, 0.989], "trained": True},
    "none": {"success": 0.1, "success_any": 0.2, "n": 50, "ci95": [0.04, 0.21], "trained": False},
}


def test_a_card_says_what_was_measured_and_how(folder):
    measure(folder, ROWS)
    text = write_card(folder).read_text()
    assert "| all | 0.96 | 0.87 – 0.99 | 1.00 | 50 |  |" in text
    assert "| none | 0.10 | 0.04 – 0.21 | 0.20 | 50 | not trained on this subset |" in text
    assert "at the last step: near. Development seeds 5000 to 5049" in text
    assert "    madviz train --task toy/reach" in text
    assert "- wall time (s): 571.2" in text and "torch" in text
    assert "| third_a | 0, 0, 2.2 | 0.9239, 0, 0, 0.3827 | 60° | nothing |" in text
    assert describe(folder).spec.digest in text
    assert text == card_text(folder)


def test_a_card_filled_in_several_goes_says_how_many_seeds_each_row_has(folder):
    measure(folder, {**ROWS, "none": {**ROWS["none"], "n": 20}})
    text = write_card(folder).read_text()
    assert "Development seeds from 5000 on, in each row as many as it has episodes; render" in text
    assert "the same for every row" not in text
    measure(folder, ROWS)
    assert "Development seeds 5000 to 5049, the same for every row; render" in card_text(folder)


def test_a_card_says_that_a_policy_was_chosen_and_its_digest_stays(folder):
    measure(folder, ROWS)
    before, digest = card_text(folder), describe(folder).spec.digest
    for trainings, words in ((2, "the better of two trainings"), (3, "the best of 3 trainings")):
        (folder / "origin.json").write_text(f'{{"best_of": {trainings}}}')
        text = card_text(folder)
        assert f"\n- chosen: {words}\n" in text and digest in text
        source = "`config.json`, `origin.json` and `evaluation.json`"
        assert (
            text.replace(f"- chosen: {words}\n", "").replace(
                source, "`config.json` and `evaluation.json`"
            )
            == before
        )
    (folder / "origin.json").write_text('{"script_before": "00ab0ab1"}')
    script = "\n- script: as it was before revision `00ab0ab1`; with today's, the"
    assert script in card_text(folder)
    for wrong in ('{"best_of": 1}', "{}", '{"best_of": 2, "of": 3}', '{"script_before": "old"}'):
        (folder / "origin.json").write_text(wrong)
        with pytest.raises(UserError, match="origin.json: .*restore the file, or remove it"):
            card_text(folder)


def test_a_card_without_an_evaluation_says_so(folder):
    assert "Not measured yet: `madviz eval --policy toy-reach-mad-light --card`" in card_text(
        folder
    )


def test_a_card_names_what_opens_these_weights(folder, monkeypatch):
    """An included policy of the same name has other ones."""
    mine = folder.rename(folder.parent / "mine")
    monkeypatch.chdir(mine)
    for text in (card_text(mine), card_text(".")):
        assert "explore --policy mine" in text and "eval --policy mine --card" in text
        assert "toy-reach-mad-light --" not in text


def test_a_card_never_shows_numbers_of_other_weights(folder):
    measure(folder, ROWS)
    save_policy(folder, make_agent(1), make_config())
    with pytest.raises(UserError, match="expected an evaluation of these weights"):
        write_card(folder)
    assert not (folder / "card.md").exists()


def test_broken_evaluations_are_named(folder):
    (folder / "evaluation.json").write_text("[")
    with pytest.raises(UserError, match="evaluation.json: expected a JSON file"):
        card_text(folder)
    measure(folder, {"all": {**ROWS["all"], "n": "many"}})
    with pytest.raises(UserError, match="expected 'subsets.*' to be a whole number"):
        card_text(folder)
