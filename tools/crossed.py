"""Trains and evaluates the design *Loss and episodes* of results/designs.md, one run at a time:

    python tools/crossed.py runs/crossed

For each task, training seed and level of episodes, one MAD run records, and every loss learns from
its episodes. Each evaluated training becomes rows of results/crossed.csv at once, so a command that
was stopped goes on where it was. A set of episodes, 0.7 GB, is removed after its last training.
"""

from __future__ import annotations

import csv
import itertools
import json
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from policy_files import ROOT

TABLE = ROOT / "results" / "crossed.csv"
TASKS = ("metaworld/push", "maniskill/push-cube")
LEVELS = ("turns", "all")
SEEDS = (1, 2, 3)
CAMERAS = ("first", "third_a", "third_b")
EPISODES = 50
FIRST_SEED = 30_000


class Loss(NamedTuple):
    """A row of the design: a method, MAD's alpha, and the camera of Single Camera."""

    method: str
    alpha: float = 0.25
    camera: str = ""


RECORDS = Loss("mad")
LOSSES = (
    RECORDS,
    Loss("mad", 0.8),
    Loss("merged-only"),
    Loss("singular-only"),
    *(Loss("single", camera=camera) for camera in CAMERAS),
)


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


def main() -> None:
    out = Path(sys.argv[1])
    for task, seed, level in itertools.product(TASKS, SEEDS, LEVELS):
        folder = out / f"{task.replace('/', '-')}-{level}-seed{seed}"
        left = [loss for loss in LOSSES if (task, level, seed, *loss) not in done()]
        for loss in left:
            recorded = folder / _name(RECORDS)
            if loss != RECORDS and not (recorded / "episodes").is_dir():
                _train(recorded, task, seed, RECORDS, _recording(level))
            options = _recording(level) if loss == RECORDS else ["--light.episodes", str(recorded)]
            _train(folder / _name(loss), task, seed, loss, options)
            _add(_evaluated(folder / _name(loss), (task, level, seed), loss))
        if folder.exists():
            shutil.rmtree(folder)


def done() -> set[tuple]:
    """The trainings that the table has."""
    if not TABLE.exists():
        return set()
    with TABLE.open(newline="") as file:
        return {
            (r["task"], r["episodes"], int(r["seed"]), r["method"], float(r["alpha"]), r["camera"])
            for r in csv.DictReader(file)
        }


def _recording(level: str) -> list[str]:
    return ["--light.keep-episodes", "--light.drivers", level]


def _name(loss: Loss) -> str:
    return "-".join([loss.method, str(loss.alpha), *([loss.camera] if loss.camera else [])])


def _train(out: Path, task: str, seed: int, loss: Loss, options: Iterable[str]) -> None:
    words = ["train", "--task", task, "--method", loss.method, "--seed", str(seed)]
    words += ["--light.alpha", str(loss.alpha), "--light.critic-updates", "0", "--out", str(out)]
    words += ["--camera", loss.camera] if loss.camera else []
    words += ["--resume"] if (out / "resume" / "run.json").exists() else []
    _madviz(*words, *options)


def _evaluated(policy: Path, place: tuple[str, str, int], loss: Loss) -> list[Row]:
    subsets = ["all"] if loss.camera else ["all", *CAMERAS]
    file = policy / "rates.json"
    words = ["--episodes", str(EPISODES), "--seed", str(FIRST_SEED), "--workers", "1"]
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


def _add(rows: list[Row]) -> None:
    new = not TABLE.exists()
    with TABLE.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows(([Row._fields] if new else []) + rows)


def _madviz(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "madviz", *words], check=True)


if __name__ == "__main__":
    main()
