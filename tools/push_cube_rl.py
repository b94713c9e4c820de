"""PushCube from rewards on one GPU, as results/designs.md fixes it, as far as the time goes:

    python tools/push_cube_rl.py OUT --minutes 10

Two runs at a time share the card, 64 environments each, stepped by processes. No run is evaluated
meanwhile, and no buffer is kept: OUT/NAME is a policy folder for ``madviz eval``. Runs that OUT has
are left out. None is begun that would not end in time, judged by the slowest one so far.
"""

from __future__ import annotations

import argparse
import itertools
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

AT_ONCE = 2
DECISIONS = 25_000
ENVIRONMENTS = 64
FIRST_GUESS = 170.0
"""Seconds of a run, before one has ended."""
METHODS = (
    ("mad",),
    ("merged-only",),
    ("single", "--camera", "third_a"),
    ("naive-both",),
)
SEEDS = (1, 2, 3, 4, 5)


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains on PushCube from rewards.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--decisions", type=int, default=DECISIONS)
    parser.add_argument("--environments", type=int, default=ENVIRONMENTS)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    asked = parser.parse_args()
    end = time.monotonic() + 60 * asked.minutes
    slowest: list[float] = []

    def carry_out(run: tuple[int, tuple[str, ...]]) -> None:
        seed, method = run
        folder = asked.out / f"{method[0]}-seed{seed}"
        expected = max(slowest, default=FIRST_GUESS)
        if (folder / "resume" / "finished").exists() or time.monotonic() + expected > end:
            return
        began = time.monotonic()
        subprocess.run(_words(folder, seed, method, asked), check=True)
        slowest.append(time.monotonic() - began)

    # In order of need: three methods by seed, then the fourth.
    runs = [*itertools.product(SEEDS, METHODS[:3]), *itertools.product(SEEDS, METHODS[3:])]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(carry_out, runs))
    done = sum((asked.out / f"{m[0]}-seed{s}/resume/finished").exists() for s, m in runs)
    print(f"{done} of {len(runs)} runs are finished in {asked.out}")


def _words(
    folder: Path, seed: int, method: tuple[str, ...], asked: argparse.Namespace
) -> list[str]:
    workers = max(1, (os.cpu_count() or 1) // AT_ONCE - 1)
    resume = ["--resume"] if (folder / "resume" / "run.json").exists() else []
    words = [sys.executable, "-m", "madviz", "train", "--task", "maniskill/push-cube"]
    words += ["--recipe", "paper-vectorised", "--seed", str(seed), "--method", *method]
    words += ["--threads", "1", "--out", str(folder), *resume]
    options = {
        "device": asked.device,
        "steps": asked.decisions,
        "workers": workers,
        "environments": asked.environments,
        "buffer-capacity": max(asked.decisions, 1000),
        "eval-episodes": 0,
        "save-every": asked.decisions,
    }
    for name, value in options.items():
        words += [f"--vectorised.{name}", str(value)]
    return words


if __name__ == "__main__":
    main()
