"""The command that trains a policy again, from what its config.json says of its training.

    asked for                 stopped at    again
    --paper.steps 150000      90,816        --paper.steps 90816
    --paper.steps 150000      –             --paper.steps 150000

A training that was stopped is repeated as long as it got, not as long as was asked for.
"""

from __future__ import annotations

import shlex

from madviz.policies.config import TrainingRecord

RUNS = "runs"
"""Where the commands put what they train, as ``madviz train`` does by itself."""
OUT = "--out"
RESUME = "--resume"
STEPS = ".steps"


def words_again(training: TrainingRecord) -> list[str]:
    """The command, word by word and without its folder; none where the config does not say."""
    words = shlex.split(training.command or "")
    if RESUME in words:
        words.remove(RESUME)
    if OUT in words:
        place = words.index(OUT)
        del words[place : place + 2]
    if training.finished is False and training.steps:
        for place, word in enumerate(words[:-1]):
            if word.startswith("--") and word.endswith(STEPS):
                words[place + 1] = str(training.steps)
    return words


def command_again(training: TrainingRecord, name: str) -> str:
    """One line that overwrites no policy: it puts its own at runs/NAME."""
    return shlex.join([*words_again(training), OUT, f"{RUNS}/{name}"])
