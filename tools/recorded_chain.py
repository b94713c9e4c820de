"""Trains on recordings of hammer's expert, and counts success in the simulator.

    python tools/recorded_chain.py runs/recorded
    python tools/recorded_chain.py runs/recorded --guard  two more trainings, played with the guard
    python tools/recorded_chain.py runs/recorded --films  two more, on LeRobot's films of 240 x 320
    python tools/recorded_chain.py runs/recorded --act    LeRobot's ACT on the same recordings

Records the expert as a LeRobot dataset with films, trains on it without the simulator, audits each
policy on the recordings, serves it, and counts its success in the simulator, by madviz's own
commands. results/designs.md has the question. Every finished piece is kept in the folder, and
each condition of each policy becomes a row of results/recorded.csv at once. ACT is trained and
served, and the larger films are written, by integrations/lerobot, whose setup.sh comes first.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
import threading
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

from policy_files import ROOT

import madviz
from madviz.envs.registry import env_spec
from madviz.guard.fit import fit_values, seen_episode
from madviz.guard.policy import GuardedPolicy
from madviz.measure.readings import LEDGER, Reading
from madviz.observation.grammar import parse_occlusions
from madviz.policies.checkpoint import describe, load_policy
from madviz.recorded.recordings import open_recordings
from madviz.recorded.split import held_out

TASK = "metaworld/hammer"
CAMERAS = ("first", "third_a", "third_b")
WAYS = ("dropped", "black", "frozen")
METHODS = ("mad", "merged-only", "singular-only")
SEEDS = (1, 2)
GUARD_SEEDS = (3, 4)
"""The trainings that are played with the guard: the weights of the first two are not kept."""
FILM_SEEDS = (5, 6)
"""The trainings on films that LeRobot's own writer made."""
ACT = "act"
LEROBOT = ROOT / "integrations" / "lerobot"
RECORDED = "--episodes 50 --seed 0 --video --format lerobot".split()
TRAINING = "--light.rounds 6 --light.updates-per-round 300 --threads 1".split()
ACT_TRAINING = "--updates 1200".split()
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
ASKED = WIRE.replace(TASK, "recording/hammer")
"""How ACT is asked about the recordings."""
FILM_WIRE = WIRE.replace("size = 84", "size = [240, 320]\nstretch = true")


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
FROZEN = Condition("first", "removed", "frozen")
BESIDE = (INTACT, FROZEN)
"""What those that are played with the guard are compared with, from the same weights."""
ON_FILMS = (*PLAIN[:4], FROZEN)
GUARDED_ON_FILMS = tuple(one for one in GUARDED if one[:3] == FROZEN[:3])


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
        return self.out / ("hammer-films" if self.seed in FILM_SEEDS else "hammer")

    @property
    def wire(self) -> Path:
        return self.out / ("wire-films.toml" if self.seed in FILM_SEEDS else "wire.toml")


def record(piece: Piece) -> None:
    """Records the expert, unless that was done, and says how the simulator is wired."""
    films = piece.seed in FILM_SEEDS
    if films and not piece.recordings.exists():
        part = piece.recordings.with_suffix(".part")
        shutil.rmtree(part, ignore_errors=True)
        subprocess.run([*_lerobot("write_recordings.py"), TASK, str(part)], check=True)
        part.rename(piece.recordings)
    if not piece.recordings.exists():
        _madviz("record", "--expert", TASK, *RECORDED, "--out", str(piece.recordings))
    piece.wire.write_text(FILM_WIRE if films else WIRE)


def train(piece: Piece) -> None:
    """Trains, audits on the recordings, and fits the guard."""
    recordings = ["--recording", str(piece.recordings)]
    if not (piece.policy / "resume" / "finished").exists():
        words = ["--method", piece.method, "--seed", str(piece.seed), "--out", str(piece.policy)]
        again = ["--resume"] if (piece.policy / "resume" / "run.json").exists() else []
        _madviz("train", *recordings, *words, *again, *TRAINING)
    _audit(piece, str(piece.policy))
    if not (piece.policy / "guard.json").exists():
        _madviz("guard", "--policy", str(piece.policy), *recordings)


def train_act(piece: Piece) -> None:
    """Trains ACT without the episodes that are held out, and audits it on the recordings."""
    if not (piece.policy / "trained").exists():
        words = ["--data", str(piece.recordings), "--out", str(piece.policy)]
        words += ["--seed", str(piece.seed), *ACT_TRAINING]
        words += ["--leave-out", *map(str, held_out(range(50)))]
        subprocess.run([*_lerobot("train_act.py"), *words], check=True)
        (piece.policy / "trained").touch()
    (piece.out / "asked.toml").write_text(ASKED)
    with _served(piece, guard=False) as address:
        _audit(piece, address, "--wire", str(piece.out / "asked.toml"))


def _audit(piece: Piece, *policy: str) -> None:
    if not _audit_of(piece).exists():
        options = ["--how", *WAYS, "--out", str(_audit_of(piece).parent)]
        _madviz("audit", "--recording", str(piece.recordings), *options, "--policy", *policy)


def evaluate(piece: Piece, conditions: Sequence[Condition]) -> None:
    """Counts the success of what is missing, with one server for all of it."""
    audit = json.loads(_audit_of(piece).read_text())
    digest = audit["digest"]
    if piece.method != ACT:
        found = describe(piece.policy).spec.digest
        assert digest == found, f"{_audit_of(piece)} is of other weights; remove it"
    known = done()
    left = [one for one in conditions if (piece.method, piece.seed, digest, *one) not in known]
    if not left:
        return
    changes = {
        (row["camera"], row["what"], row["how"]): f"{row['change']['mean']:.4f}"
        for row in audit["conditions"]
    }
    with _served(piece, left[0].guard) as address:
        for one in left:
            file = piece.policy / f"rates-{one.camera}-{one.what}-{one.how}.json"
            words = ["--policy", address, "--wire", str(piece.wire), *one.words]
            words += ["--workers", "1", "--json", str(file)]
            words += ["--episodes", str(COUNT), "--seed", str(FIRST_SEED)]
            _madviz("eval", *words)
            played = json.loads(file.read_text())["episodes"]
            change = "" if one.guard else changes.get(one[:3], "")
            if one == INTACT:
                _note(piece, digest)
            known_as = piece.method, piece.seed, digest
            _add(Row(*known_as, *one, change, FIRST_SEED, *_outcomes(played)))


def evaluate_guarded_act(piece: Piece) -> None:
    """Counts the success of ACT with a guard that is fitted on the recordings, in Python: a server
    of another program has none."""
    digest = json.loads(_audit_of(piece).read_text())["digest"]
    left = [one for one in GUARDED if (piece.method, piece.seed, digest, *one) not in done()]
    recordings = open_recordings(piece.recordings)
    learned = [one.index for one in recordings.episodes if one.index not in recordings.held_out]
    seen = [
        seen_episode(
            [dict(zip(CAMERAS, step, strict=True)) for step in recordings.frames(index, 84)],
            recordings.numbers(index)[0],
        )
        for index in learned[:12]
    ]
    values = fit_values(seen, (84, 84), env_spec(TASK).state_numbers.robot)
    with _served(piece, guard=False) as address:
        policy = GuardedPolicy(load_policy(address), values)
        for one in left:
            found = madviz.evaluate(
                policy,
                ["all"],
                episodes=COUNT,
                seed=FIRST_SEED,
                workers=0,
                occlusions=parse_occlusions([f"{one.camera}={one.how}"]),
            )
            played = [asdict(episode) for episode in found.episodes]
            known_as = piece.method, piece.seed, digest
            _add(Row(*known_as, *one, "", FIRST_SEED, *_outcomes(played)))


def _outcomes(played: list[dict[str, Any]]) -> Iterator[str]:
    """A digit for each episode, at the last step and at any step."""
    played.sort(key=lambda episode: episode["seed"])
    for key in ("success", "success_any"):
        yield "".join(str(int(episode[key])) for episode in played)


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
def _served(piece: Piece, guard: bool) -> Iterator[str]:
    """The address of a server of the policy, which says it once it is there."""
    if piece.method == ACT:
        words = [*_lerobot("serve_policy.py"), str(piece.policy), "--task", TASK, "--port", "0"]
    else:
        options = ["--guard"] if guard else []
        words = _command("serve", "--policy", str(piece.policy), "--port", "0", *options)
    server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    try:
        yield next(line for line in server.stdout if "ws://" in line).split()[-1]
    finally:
        server.terminate()
        server.wait()


def _with_act(piece: Piece) -> None:
    train_act(piece)
    evaluate(piece, PLAIN[:1])
    with ThreadPoolExecutor(TRAIN_AT_ONCE) as pool:
        list(pool.map(lambda these: evaluate(piece, these), (PLAIN[1:7], PLAIN[7:])))
    evaluate_guarded_act(piece)


def _lerobot(file: str) -> list[str]:
    return [str(LEROBOT / ".venv" / "bin" / "python"), str(LEROBOT / file)]


def _madviz(*words: str) -> None:
    subprocess.run(_command(*words), check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})


def _command(*words: str) -> list[str]:
    return [sys.executable, "-m", "madviz", *words]


def main(words: Sequence[str]) -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--guard", action="store_true", help="two more trainings, with the guard")
    parser.add_argument("--films", action="store_true", help="two more, on larger films")
    parser.add_argument("--act", action="store_true", help="LeRobot's ACT, one training")
    asked = parser.parse_args(words)
    out = asked.out
    out.mkdir(parents=True, exist_ok=True)
    if asked.films:
        seeds, played = FILM_SEEDS, (ON_FILMS, GUARDED_ON_FILMS)
    elif asked.guard:
        seeds, played = GUARD_SEEDS, (BESIDE, GUARDED[:3], GUARDED[3:])
    else:
        seeds, played = SEEDS, (PLAIN[:7], PLAIN[7:])
    record(Piece(METHODS[0], seeds[0], out))
    if asked.act:
        _with_act(Piece(ACT, 1, out))
        return
    pieces = [Piece(method, seed, out) for seed in seeds for method in METHODS]
    with ThreadPoolExecutor(TRAIN_AT_ONCE) as pool:
        list(pool.map(train, pieces))
    with ThreadPoolExecutor(EVALUATE_AT_ONCE) as pool:
        for conditions in played:
            list(pool.map(lambda piece, these=conditions: evaluate(piece, these), pieces))


if __name__ == "__main__":
    main(sys.argv[1:])
