"""Trains on recordings of hammer's expert, and counts success in the simulator.

    python tools/recorded_chain.py runs/recorded

Records the expert as a LeRobot dataset with films, trains on it without the simulator, audits each
policy on the recordings, serves it, and counts its success in the simulator, by madviz's own
commands. results/designs.md has the question. Every finished piece is kept in the folder, and
each condition of each policy becomes a row of results/recorded.csv at once.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import threading
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import NamedTuple

from policy_files import ROOT

from madviz.measure.readings import LEDGER, Reading
from madviz.policies.checkpoint import describe

TASK = "metaworld/hammer"
CAMERAS = ("first", "third_a", "third_b")
METHODS = ("mad", "merged-only", "singular-only")
SEEDS = (1, 2)
RECORDED = "--episodes 50 --seed 0 --video --format lerobot".split()
TRAINING = "--light.rounds 6 --light.updates-per-round 300 --threads 1".split()
FIRST_SEED = 47_000
COUNT = 50
TRAIN_AT_ONCE = 2
EVALUATE_AT_ONCE = 4
"""Policies; evaluating one, a server and a worker wait for each other."""
TABLE = ROOT / "results" / "recorded.csv"
_WRITING = threading.Lock()
WIRE = f"""task = "{TASK}"
size = 84
state = "state"
masks = true
cameras = {{ {", ".join(f'{name} = "{name}"' for name in CAMERAS)} }}
"""


class Condition(NamedTuple):
    """A camera, and how it fails; no camera: all are intact."""

    camera: str
    what: str
    """removed or alone."""
    how: str
    """dropped, black or frozen."""
    guard: bool = False

    @property
    def words(self) -> list[str]:
        """The options of ``madviz eval``."""
        if self.how not in ("", "dropped"):
            return ["--subsets", "all", "--occlude", f"{self.camera}={self.how}"]
        if not self.camera:
            return ["--subsets", "all"]
        rest = [name for name in CAMERAS if name != self.camera]
        return ["--subsets", self.camera if self.what == "alone" else "+".join(rest)]


INTACT = Condition("", "", "")
PLAIN = (
    INTACT,
    *(Condition(name, "removed", "dropped") for name in CAMERAS),
    *(Condition(name, "removed", "black") for name in CAMERAS),
    *(Condition(name, "alone", "dropped") for name in CAMERAS),
    *(Condition(name, "removed", "frozen") for name in CAMERAS),
)
GUARDED = tuple(
    Condition(name, "removed", how, guard=True) for how in ("black", "frozen") for name in CAMERAS
)


class Row(NamedTuple):
    """One condition of one policy; outcomes are a digit for each episode, 1 for a success."""

    method: str
    seed: int
    digest: str
    """The policy's, of its weights."""
    camera: str
    what: str
    how: str
    guard: bool
    change: str
    """The change of the action in held-out recordings, in spreads; '' with the guard, and where
    nothing is broken."""
    first_seed: int
    at_last_step: str
    at_any_step: str


class Piece(NamedTuple):
    """A training."""

    method: str
    seed: int
    out: Path

    @property
    def policy(self) -> Path:
        return self.out / f"{self.method}-seed{self.seed}"

    @property
    def recordings(self) -> Path:
        return self.out / "hammer"


def train(piece: Piece) -> None:
    """Trains, audits on the recordings, and fits the guard."""
    recordings = ["--recording", str(piece.recordings)]
    if not (piece.policy / "resume" / "finished").exists():
        words = ["--method", piece.method, "--seed", str(piece.seed), "--out", str(piece.policy)]
        again = ["--resume"] if (piece.policy / "resume" / "run.json").exists() else []
        _madviz("train", *recordings, *words, *again, *TRAINING)
    known = ["--policy", str(piece.policy), *recordings]
    if not _audit_of(piece).exists():
        how = ["--how", "dropped", "black", "frozen"]
        _madviz("audit", *known, *how, "--out", str(_audit_of(piece).parent))
    if not (piece.policy / "guard.json").exists():
        _madviz("guard", *known)


def evaluate(piece: Piece, conditions: Sequence[Condition]) -> None:
    """Counts the success of what is missing, with one server for all of it."""
    audit = json.loads(_audit_of(piece).read_text())
    digest = describe(piece.policy).spec.digest
    assert audit["digest"] == digest, f"{_audit_of(piece)} is of other weights; remove it"
    known = done()
    left = [one for one in conditions if (piece.method, piece.seed, digest, *one) not in known]
    if not left:
        return
    changes = {
        (row["camera"], row["what"], row["how"]): f"{row['change']['mean']:.4f}"
        for row in audit["conditions"]
    }
    file = piece.policy / "rates.json"
    with _served(piece.policy, left[0].guard) as address:
        for one in left:
            words = ["--policy", address, "--wire", str(piece.out / "wire.toml"), *one.words]
            words += ["--workers", "1", "--json", str(file)]
            words += ["--episodes", str(COUNT), "--seed", str(FIRST_SEED)]
            _madviz("eval", *words)
            played = json.loads(file.read_text())["episodes"]
            played.sort(key=lambda episode: episode["seed"])
            last, ever = (
                "".join(str(int(episode[key])) for episode in played)
                for key in ("success", "success_any")
            )
            change = "" if one.guard else changes.get(one[:3], "")
            if one == INTACT:
                _note(piece, digest)
            _add(Row(piece.method, piece.seed, digest, *one, change, FIRST_SEED, last, ever))


def done() -> set[tuple]:
    """The conditions that the table has."""
    if not TABLE.exists():
        return set()
    with TABLE.open(newline="") as file:
        return {
            (one["method"], int(one["seed"]), one["digest"], *condition_of(one))
            for one in csv.DictReader(file)
        }


def condition_of(row: dict[str, str]) -> Condition:
    """The condition of a row of the table."""
    return Condition(row["camera"], row["what"], row["how"], row["guard"] == "True")


def _audit_of(piece: Piece) -> Path:
    return piece.out / f"audit-{piece.policy.name}" / "audit.json"


def _add(row: Row) -> None:
    with _WRITING:
        new = not TABLE.exists()
        with TABLE.open("a", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(([Row._fields] if new else []) + [row])


def _note(piece: Piece, digest: str) -> None:
    """Adds a policy to the ledger of readings, with its first rate."""
    name = f"recorded-{piece.policy.name}"
    last = FIRST_SEED + COUNT - 1
    row = Reading(date.today().isoformat(), name, TASK, digest, FIRST_SEED, last)
    with _WRITING, (ROOT / LEDGER).open("a", newline="") as file:
        csv.writer(file, lineterminator="\n").writerow(row)


@contextmanager
def _served(policy: Path, guard: bool) -> Iterator[str]:
    """The address of a server of ``policy``, which says it in its first line."""
    words = ["serve", "--policy", str(policy), "--port", "0", *(["--guard"] if guard else [])]
    server = subprocess.Popen(_command(*words), stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    try:
        yield server.stdout.readline().split()[-1]
    finally:
        server.terminate()
        server.wait()


def _madviz(*words: str) -> None:
    subprocess.run(_command(*words), check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})


def _command(*words: str) -> list[str]:
    return [sys.executable, "-m", "madviz", *words]


def main(words: Sequence[str]) -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    out = parser.parse_args(words).out
    out.mkdir(parents=True, exist_ok=True)
    if not (out / "hammer").exists():
        _madviz("record", "--expert", TASK, *RECORDED, "--out", str(out / "hammer"))
    (out / "wire.toml").write_text(WIRE)
    pieces = [Piece(method, seed, out) for seed in SEEDS for method in METHODS]
    with ThreadPoolExecutor(TRAIN_AT_ONCE) as pool:
        list(pool.map(train, pieces))
    with ThreadPoolExecutor(EVALUATE_AT_ONCE) as pool:
        for conditions in (PLAIN[:7], PLAIN[7:10], PLAIN[10:], GUARDED[:3], GUARDED[3:]):
            list(pool.map(lambda piece, these=conditions: evaluate(piece, these), pieces))


if __name__ == "__main__":
    main(sys.argv[1:])
