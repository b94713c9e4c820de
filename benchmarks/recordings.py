"""``benchmarks recordings``: films of a robot, from their folder to a training: time and memory.

Writes made-up episodes of three cameras as a LeRobot dataset with films, then trains MAD on it in
a process of its own, as ``madviz train --recording`` does:

    frames_per_s  pictures of one camera a second: read in order, fitted to 84 pixels, kept
    round_s       seconds of a round: updates, errors on held-out episodes, a saved state
    memory_mb     the largest resident memory of that process, mapped pictures among it

With ``--lerobot PYTHON``, the interpreter of an environment that has LeRobot, its own loader reads
some of the same films by index, as its training does, at their own size.
"""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np

from benchmarks.memory import kilobytes
from madviz.envs.registry import env_spec
from madviz.errors import UserError
from madviz.recording.lerobot import Decision, write_dataset
from madviz.system.numbers import Count, Range, check_numbers
from madviz.types import Array

CAMERAS = ("first", "third_a", "third_b")
NUMBERS = 7
FPS = 30.0
LOADED = 100
"""Steps that LeRobot's loader decodes, at most."""
LOADER = """import sys, time
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("made/up", root=sys.argv[1], video_backend="pyav", return_uint8=True)
data[0]
began = time.perf_counter()
for index in range(int(sys.argv[2])):
    data[index]
print(int(sys.argv[2]) * len(data.meta.camera_keys) / (time.perf_counter() - began))
"""


@dataclass(frozen=True)
class BenchRecordingsConfig:
    """Times the decoding of recordings and a training on them, and says the memory."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    episodes: Annotated[int, Range(int, 2, 10_000)] = 50
    """Episodes of three cameras."""
    steps: Annotated[int, Range(int, 4, 10_000)] = 100
    """Steps of an episode."""
    height: Count = 480
    """Rows of a picture."""
    width: Count = 640
    """Columns of a picture."""
    rounds: Count = 3
    """Rounds of updates; the default of a training is 12. The first, which warms up, does not count
    where there are more."""
    updates: Count = 300
    """Updates of a round."""
    lerobot: Path | None = None
    """An interpreter that has LeRobot."""


def bench_recordings(config: BenchRecordingsConfig) -> dict[str, Any]:
    """The module's numbers. Raises UserError for a Python without LeRobot, and where the training
    fails."""
    check_numbers(config)
    if config.lerobot is not None:
        _check_lerobot(config.lerobot)
    with TemporaryDirectory() as place:
        folder = Path(place) / "films"
        rng = np.random.default_rng(0)
        size = (config.height, config.width)
        episodes = (made_up(rng, config.steps, size) for _ in range(config.episodes))
        write_dataset(folder, env_spec("toy/reach"), FPS, episodes, video=True)
        result: dict[str, Any] = {"schema": 1, "episodes": config.episodes, "steps": config.steps}
        result |= {"height": config.height, "width": config.width}
        result |= _trained(Path(place), config)
        if config.lerobot is not None:
            steps = str(min(LOADED, config.episodes * config.steps))
            found = subprocess.run(
                [config.lerobot, "-c", LOADER, folder, steps],
                capture_output=True,
                text=True,
                check=True,
                env=os.environ | {"HF_HOME": place},
            )
            result["lerobot_frames_per_s"] = float(found.stdout.split()[-1])
            result["times_lerobot"] = result["frames_per_s"] / result["lerobot_frames_per_s"]
    return result


def made_up(rng: np.random.Generator, steps: int, size: tuple[int, int]) -> Iterator[Decision]:
    """An episode of a bright square that follows a random walk, on a ground that slowly moves."""
    height, width = size
    places = np.cumsum(rng.normal(size=(steps, 2)), axis=0)
    mask = np.ones(len(CAMERAS), bool)
    for step, (row, column) in enumerate(places):
        pictures = {
            name: _picture(step + 40 * number, int(8 * row), int(8 * column), height, width)
            for number, name in enumerate(CAMERAS)
        }
        state = np.resize(places[step], NUMBERS).astype(np.float32)
        action = np.tanh(rng.normal(size=NUMBERS) / 3 - state / 9).astype(np.float32)
        yield Decision(pictures, mask, state, action, 0.0, False)


def _picture(phase: int, row: int, column: int, height: int, width: int) -> Array:
    picture = np.empty((height, width, 3), np.uint8)
    wave = np.linspace(0, 6, width) + phase / 9
    picture[:] = (120 + 80 * np.sin(wave))[None, :, None]
    picture[..., 1] = np.linspace(20, 230, height)[:, None]
    top = (height // 2 + row) % height
    left = (width // 2 + column) % width
    picture[top : top + height // 8, left : left + height // 8] = (250, 20, 20)
    return picture


def _trained(place: Path, config: BenchRecordingsConfig) -> dict[str, Any]:
    """Decoding, a round, and the memory of a training."""
    words = [sys.executable, "-m", "madviz", "train", "--recording", place / "films"]
    words += ["--method", "mad", "--out", place / "mad", "--light.rounds", config.rounds]
    words += ["--light.updates-per-round", config.updates]
    times = []
    memory = 0.0
    with subprocess.Popen(
        [str(word) for word in words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"XDG_CACHE_HOME": str(place / "cache")},
    ) as child:
        assert child.stdout is not None
        said = []
        for line in child.stdout:
            said.append(line)
            if line.startswith("[pictures]"):
                times.append(time.monotonic())
            memory = max(memory, _megabytes(child.pid))
    if child.returncode:
        raise UserError(f"expected a training, found that it failed: {said[-1]:.200}")
    rows = list(csv.DictReader((place / "mad" / "curve.csv").read_text().splitlines()))
    seconds = [0.0, *(float(row["seconds"]) for row in rows)]
    rounds = [later - earlier for earlier, later in pairwise(seconds)]
    decoded = (config.episodes - 1) * config.steps * len(CAMERAS)
    return {
        "frames_per_s": decoded / (times[-1] - times[0]),
        "round_s": float(np.mean(rounds[1:] or rounds)),
        "memory_mb": memory,
    }


def _megabytes(process: int) -> float:
    """The largest resident memory so far, 0 where the process has ended."""
    try:
        return (kilobytes("VmHWM", Path(f"/proc/{process}/status")) or 0) / 1024
    except OSError:
        return 0.0


def _check_lerobot(python: Path) -> None:
    """Raises UserError where ``python`` cannot import LeRobot: before the long work, not after."""
    try:
        found = subprocess.run([python, "-c", "import lerobot"], capture_output=True, text=True)
        said = found.stderr.splitlines() or [f"exit status {found.returncode}"]
        why = said[-1] if found.returncode else ""
    except OSError as error:
        why = str(error)
    if why:
        raise UserError(
            f"expected a Python with LeRobot in {python}, found: {why:.200}; "
            "integrations/lerobot/setup.sh makes one"
        )
