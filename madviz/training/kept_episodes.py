"""Episodes that another run kept, for a loss that shall learn from the same ones.

Methods that drive in their own recordings differ in their episodes as well as in their loss. A run
with ``--light.keep-episodes`` leaves its recordings in its folder, ``episodes/RRR-NN.npz`` for
episode NN of round RRR; a run with ``--light.episodes`` reads them round by round, as they came.
"""

from __future__ import annotations

from pathlib import Path

from madviz.errors import UserError
from madviz.policies.checkpoint import CONFIG
from madviz.policies.config import check_environment, read_config
from madviz.runs.demonstrations import Episode
from madviz.runs.training_plan import TrainingPlan
from madviz.training.light_options import RECORDING, LightConfig

FOLDER = "episodes"


def episode_files(folder: Path) -> dict[int, list[Path]]:
    """Round -> the files of its episodes, in order of their numbers."""
    files: dict[int, list[Path]] = {}
    for file in sorted(folder.glob("*-*.npz"), key=_numbers):
        files.setdefault(_numbers(file)[0], []).append(file)
    return files


def _numbers(file: Path) -> tuple[int, ...]:
    return tuple(map(int, file.stem.split("-")))


class KeptEpisodes:
    """The episodes in the run's folder that ``config.episodes`` names."""

    def __init__(self, plan: TrainingPlan, config: LightConfig) -> None:
        """Raises UserError for options that only recording has, and for a folder without episodes,
        of another environment, without one of the streams, or with fewer rounds."""
        run = Path(config.episodes)
        if asked := config.asked(RECORDING):
            raise UserError(
                f"expected light.episodes without options of recording, found {', '.join(asked)}; "
                "leave them out: these episodes are recorded already"
            )
        self._files = episode_files(run / FOLDER)
        if not self._files or not (run / CONFIG).is_file():
            raise UserError(
                f"expected the folder of a run with kept episodes, found none in {run}; train one "
                "with --light.keep-episodes"
            )
        recorded = read_config(run / CONFIG)[0].spec("")
        check_environment(recorded, plan.env)
        missing = set(plan.spec.streams) - set(recorded.streams)
        if missing:
            raise UserError(
                f"expected {', '.join(sorted(missing))} in the episodes of {run}, found "
                f"{', '.join(recorded.streams)}; record them with a setting that has both"
            )
        asked_for = [config.demonstrations] + [config.episodes_per_round] * (config.rounds - 1)
        found = [len(files) for _, files in sorted(self._files.items())]
        if found != asked_for:
            raise UserError(
                f"expected {len(asked_for)} rounds of {sum(asked_for)} episodes in {run}, found "
                f"{len(found)} of {sum(found)}; give the rounds and episodes of that run"
            )

    def round(self, round_index: int) -> list[Episode]:
        """The episodes of one round; none after the last."""
        return [Episode.load(file) for file in self._files.get(round_index, [])]
