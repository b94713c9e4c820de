"""Trains and evaluates two designs of results/designs.md, one training at a time:

    python tools/designs.py crossed runs/crossed    Loss and episodes, on two robot tasks
    python tools/designs.py rewards runs/rewards    Reinforcement learning, toy/reach

With a task or training seeds as the last words it makes these runs alone. Each evaluated training
becomes rows of results/NAME.csv at once, so a command that was stopped goes on where it was. In
*crossed*, for each task, training seed and level of episodes, one MAD run records, and every loss
learns from its episodes; a policy is evaluated while the next is trained. The actions of these
episodes are in results/crossed until the last training is evaluated, so that another machine can go
on with the same episodes. The folder of the runs, with weights and 0.7 GB of episodes, is removed
then, too; the CSV is all that stays.
"""

from __future__ import annotations

import csv
import itertools
import json
import shutil
import subprocess
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

from policy_files import ROOT
from recorded_actions import keep, play_again

from madviz.policies.checkpoint import CONFIG

TASKS = ("metaworld/push", "maniskill/push-cube")
LEVELS = ("turns", "all")
SEEDS = (1, 2, 3)
CAMERAS = ("first", "third_a", "third_b")
FIRST_SEED = 30_000


class Loss(NamedTuple):
    """A row of a design: a method, MAD's alpha, and the camera of Single Camera."""

    method: str
    alpha: float = 0.25
    camera: str = ""

    @property
    def name(self) -> str:
        """The folder of a training."""
        parts = [self.method, str(self.alpha), *([self.camera] if self.camera else [])]
        return "-".join(parts)


RECORDS = Loss("mad")
LOSSES = (
    RECORDS,
    Loss("mad", 0.8),
    Loss("merged-only"),
    Loss("singular-only"),
    *(Loss("single", camera=camera) for camera in CAMERAS),
)
LEFT_OUT = {"maniskill/push-cube": ("singular-only", "single")}
"""Methods that a task is not trained with."""
FROM_REWARDS = (
    Loss("mad", 0.8),
    Loss("merged-only", 0.8),
    Loss("singular-only", 0.8),
    Loss("naive-both", 0.8),
    Loss("single", 0.8, "third_a"),
)
REWARDS = (
    "--recipe paper-vectorised --vectorised.steps 6000 --vectorised.batch-size 64 "
    "--vectorised.discount 0.9 --vectorised.hidden-dim 512 --vectorised.workers 0 "
    "--vectorised.eval-every 6000 --threads 1"
).split()
"""The options of an earlier training on toy/reach; alpha is the recipe's, 0.8."""


class Row(NamedTuple):
    """One subset of one training; outcomes are a digit for each episode, 1 for a success."""

    task: str
    episodes: str
    seed: int
    method: str
    alpha: float
    camera: str
    subset: str
    first_seed: int
    at_last_step: str
    at_any_step: str


def crossed(out: Path, tasks: Sequence[str], seeds: Sequence[int]) -> None:
    """*Loss and episodes*."""
    finishing: list[Future[None]] = []
    with ThreadPoolExecutor(1) as beside:
        for rest in _trained(out, tasks or TASKS, seeds or SEEDS):
            finishing.append(beside.submit(rest))
            for one in finishing:
                if one.done():
                    one.result()  # An error ends the command before the next training.
    for one in finishing:
        one.result()


def _trained(out: Path, tasks: Sequence[str], seeds: Sequence[int]) -> Iterator[Callable]:
    """Trains; after each training yields what is left to do for it."""
    table = ROOT / "results" / "crossed.csv"
    for task, seed, level in itertools.product(tasks, seeds, LEVELS):
        name = f"{task.replace('/', '-')}-{level}-seed{seed}"
        folder, actions = out / name, table.with_suffix("") / name
        left_out = LEFT_OUT.get(task, ())
        of_level = [loss for loss in LOSSES if level == "turns" or not loss.camera]
        losses = [loss for loss in of_level if loss.method not in left_out]
        recorded = folder / RECORDS.name
        left = [loss for loss in losses if (task, level, seed, *loss) not in done(table)]
        for loss in left:
            options = _recording(level)
            if loss != RECORDS:
                if not (recorded / CONFIG).exists():
                    play_again(actions, recorded, seed)
                # Nothing is recorded beside it: two threads learn.
                options = ["--light.episodes", str(recorded), "--threads", "2"]
            _train(folder / loss.name, task, seed, loss, _imitation(loss, options))
            if loss == RECORDS:
                keep(recorded, actions)
            yield partial(_counted, table, folder / loss.name, (task, level, seed), loss)
        yield partial(_removed, (folder, actions))


def _counted(table: Path, policy: Path, place: tuple[str, str, int], loss: Loss) -> None:
    _add(table, _evaluated(policy, place, loss, 50))


def _removed(folders: Iterable[Path]) -> None:
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


def rewards(out: Path, tasks: Sequence[str], seeds: Sequence[int]) -> None:
    """*Reinforcement learning*, the part on toy/reach."""
    table = ROOT / "results" / "rewards.csv"
    runs = itertools.product(tasks or ["toy/reach"], seeds or range(1, 6), FROM_REWARDS)
    for task, seed, loss in runs:
        place = (task, "its own", seed)
        if (*place, *loss) in done(table):
            continue
        folder = out / f"{loss.name}-seed{seed}"
        _train(folder, task, seed, loss, REWARDS)
        _add(table, _evaluated(folder, place, loss, 100))


def done(table: Path) -> set[tuple]:
    """The trainings that ``table`` has."""
    if not table.exists():
        return set()
    with table.open(newline="") as file:
        return {
            (r["task"], r["episodes"], int(r["seed"]), r["method"], float(r["alpha"]), r["camera"])
            for r in csv.DictReader(file)
        }


def _recording(level: str) -> list[str]:
    return ["--light.keep-episodes", "--light.drivers", level]


def _imitation(loss: Loss, options: Iterable[str]) -> list[str]:
    return ["--light.alpha", str(loss.alpha), "--light.critic-updates", "0", *options]


def _train(out: Path, task: str, seed: int, loss: Loss, options: Iterable[str]) -> None:
    words = ["train", "--task", task, "--method", loss.method, "--seed", str(seed)]
    words += ["--out", str(out), *(["--camera", loss.camera] if loss.camera else [])]
    words += ["--resume"] if (out / "resume" / "run.json").exists() else []
    _madviz(*words, *options)


def _evaluated(policy: Path, place: tuple[str, str, int], loss: Loss, count: int) -> list[Row]:
    subsets = ["all"] if loss.camera else ["all", *CAMERAS]
    file = policy / "rates.json"
    words = ["--episodes", str(count), "--seed", str(FIRST_SEED), "--workers", "1"]
    _madviz("eval", "--policy", str(policy), "--subsets", *subsets, *words, "--json", str(file))
    episodes = json.loads(file.read_text())["episodes"]
    rows = []
    for subset in subsets:
        played = sorted((e for e in episodes if e["subset"] == subset), key=lambda e: e["seed"])
        last, ever = (
            "".join(str(int(episode[key])) for episode in played)
            for key in ("success", "success_any")
        )
        rows.append(Row(*place, *loss, subset, FIRST_SEED, last, ever))
    return rows


def _add(table: Path, rows: list[Row]) -> None:
    new = not table.exists()
    with table.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows(([Row._fields] if new else []) + rows)


def _madviz(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "madviz", *words], check=True)


DESIGNS = {"crossed": crossed, "rewards": rewards}


def main(words: Sequence[str]) -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("design", choices=DESIGNS)
    parser.add_argument("out", type=Path)
    parser.add_argument("chosen", nargs="*", help="tasks and seeds; by default all")
    asked = parser.parse_args(words)
    tasks = [word for word in asked.chosen if not word.isdigit()]
    DESIGNS[asked.design](asked.out, tasks, [int(one) for one in asked.chosen if one.isdigit()])


if __name__ == "__main__":
    main(sys.argv[1:])
