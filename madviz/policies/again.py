"""The command that trains a policy again, from what its config.json says of its training.

    asked for                 stopped at    again
    --paper.steps 150000      90,816        --paper.steps 90816
    --paper.steps 150000      –             --paper.steps 150000
    –                         90,816        --paper.steps 90816

A training by rewards that was stopped is repeated as long as it got, not as long as was asked for.
But the learning rates of mv-mwm fall over all steps: a shorter run would be another one, so the
command is the one that was given.
"""

from __future__ import annotations

import shlex

from madviz.policies.config import TrainingRecord

RUNS = "runs"
"""Where the commands put what they train, as ``madviz train`` does by itself."""
OUT = "--out"
RESUME = "--resume"
STEPS = ".steps"
RECIPE = "--recipe"
SECTIONS = {"paper": "paper", "paper-vectorised": "vectorised"}
"""Recipes that can end at any step, and where their options stand."""


def words_again(training: TrainingRecord) -> list[str]:
    """The command, word by word and without its folder; none where the config does not say."""
    words = shlex.split(training.command or "")
    if RESUME in words:
        words.remove(RESUME)
    if OUT in words:
        place = words.index(OUT)
        del words[place : place + 2]
    if training.finished is False and training.steps and words:
        asked = [place for place, word in enumerate(words[:-1]) if is_length(word)]
        for place in asked:
            words[place + 1] = str(training.steps)
        recipe = words[words.index(RECIPE) + 1] if RECIPE in words[:-1] else ""
        if not asked and recipe in SECTIONS:
            words += [f"--{SECTIONS[recipe]}{STEPS}", str(training.steps)]
    return words


def is_length(word: str) -> bool:
    """True for the option that says how many steps a training takes."""
    return word in {f"--{section}{STEPS}" for section in SECTIONS.values()}


def command_again(training: TrainingRecord, name: str) -> str:
    """One line that overwrites no policy: it puts its own at runs/NAME."""
    return shlex.join([*words_again(training), OUT, f"{RUNS}/{name}"])
