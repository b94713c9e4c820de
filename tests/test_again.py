"""The command that trains a policy again."""

from __future__ import annotations

from typing import Any

import pytest

from madviz.policies.again import command_again, words_again
from madviz.policies.config import TrainingRecord

PLAIN = "madviz train --task toy/reach"


def again(command: str, **facts: Any) -> str:
    return command_again(TrainingRecord(command=command, **facts), "toy")


def test_it_overwrites_no_policy() -> None:
    once = f"{PLAIN} --out checkpoints/toy --light.alpha 0.2 --resume"
    assert again(once) == f"{PLAIN} --light.alpha 0.2 --out runs/toy"
    assert again(PLAIN) == f"{PLAIN} --out runs/toy"
    assert command_again(TrainingRecord(command=PLAIN), "a b") == f"{PLAIN} --out 'runs/a b'"


@pytest.mark.parametrize(("finished", "steps"), [(False, 90), (True, 150), (None, 150)])
def test_a_stopped_training_is_repeated_as_long_as_it_got(finished, steps) -> None:
    asked = f"{PLAIN} --vectorised.steps 150 --vectorised.workers 4"
    expected = f"{PLAIN} --vectorised.steps {steps} --vectorised.workers 4 --out runs/toy"
    assert again(asked, steps=90, finished=finished) == expected


@pytest.mark.parametrize(
    ("recipe", "option"),
    [("paper", "paper"), ("paper-vectorised", "vectorised")],
)
def test_a_training_of_the_usual_length_that_was_stopped_says_how_far_it_got(
    recipe: str, option: str
) -> None:
    asked = f"{PLAIN} --recipe {recipe}"
    expected = f"{asked} --{option}.steps 90 --out runs/toy"
    assert again(asked, steps=90, finished=False) == expected
    assert again(asked, steps=90, finished=True) == f"{asked} --out runs/toy"
    other = f"{asked} --{option}.exploration-steps 7"
    expected = f"{other} --{option}.steps 90 --out runs/toy"
    assert again(other, steps=90, finished=False) == expected


def test_a_training_whose_rates_fall_over_its_length_keeps_that() -> None:
    asked = f"{PLAIN} --recipe mv-mwm --mv-mwm.steps 20000"
    assert again(asked, steps=10_000, finished=False) == f"{asked} --out runs/toy"


def test_rounds_are_no_steps() -> None:
    asked = f"{PLAIN} --light.rounds 3"
    assert again(asked, environment_steps=90, finished=False) == f"{asked} --out runs/toy"


def test_a_config_without_a_command_has_none() -> None:
    assert words_again(TrainingRecord()) == []
