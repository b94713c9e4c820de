"""A small sweep, a program that stands for ``madviz``, and what must be true of both at the end."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from madviz.sweep.sweep import SweepConfig

PROGRAM = """
import json, sys, time
from pathlib import Path

verb, words = sys.argv[1], sys.argv[2:]


def option(name):
    return words[words.index(name) + 1]


if verb == "train":
    out = Path(option("--out"))
    (out / "resume").mkdir(parents=True, exist_ok=True)
    run = out / "resume" / "run.json"
    if run.exists() != ("--resume" in words):
        sys.exit("told to resume where there is nothing, or not where there is a run")
    run.write_text("{}")
    if option("--seed") == "13":
        sys.exit("madviz: the thirteenth always fails")
    steps = out / "steps.txt"
    done = len(steps.read_text().split()) if steps.exists() else 0
    for step in range(done, int(option("--light.rounds"))):
        time.sleep(int(option("--threads")) / 1000)
        with steps.open("a") as file:
            file.write(f"{step}\\n")
    (out / "resume" / "finished").touch()
    (out / "config.json").write_text(json.dumps({"training": {"finished": True}}))
    with (out / "trained.txt").open("a") as file:
        file.write("once\\n")
else:
    policy = Path(option("--policy"))
    row = {"success": 0.5, "n": int(option("--episodes")), "ci95": [0.2, 0.8]}
    Path(option("--json")).write_text(json.dumps({"subsets": {"all": row}}))
    with (policy / "evaluated.txt").open("a") as file:
        file.write("once\\n")
"""


def sweep_file(folder: Path, seeds: str = "[1, 2]", rounds: int = 3, pause: int = 0) -> str:
    """Two methods on one task; ``pause`` is in milliseconds for each of ``rounds`` steps."""
    file = folder / "grid.toml"
    file.write_text(
        f'[grid]\ntasks = ["toy/reach"]\nmethods = ["mad", "merged-only"]\nseeds = {seeds}\n'
        f"[grid.train]\nlight.rounds = {rounds}\nthreads = {pause}\n[eval]\nepisodes = 4\n"
    )
    return str(file)


def stand_in(folder: Path) -> list[str]:
    """Stands for ``madviz``: counts what it did, resumes, and fails with seed 13."""
    file = folder / "program.py"
    file.write_text(PROGRAM)
    return [sys.executable, "-I", "-S", str(file)]


def config(tmp_path: Path, **change: Any) -> SweepConfig:
    sizes = {k: change.pop(k) for k in ("seeds", "rounds", "pause") if k in change}
    return SweepConfig(sweep_file(tmp_path, **sizes), out=tmp_path / "out", **change)


def lines(folder: Path, name: str) -> list[str]:
    return (folder / "policy" / name).read_text().split()


def assert_done_once(out: Path, rounds: int) -> None:
    """Every run has its result; no step, no training and no evaluation was done twice."""
    folders = sorted(path for path in out.iterdir() if path.is_dir())
    assert len(folders) == 4
    for folder in folders:
        assert (folder / "result.json").is_file()
        assert lines(folder, "steps.txt") == [str(step) for step in range(rounds)], folder
        assert lines(folder, "trained.txt") == lines(folder, "evaluated.txt") == ["once"]
