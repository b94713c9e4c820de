"""Servers that a wire file misunderstands in one way each, and what ``madviz wiring`` says of them.

    python -m tests.wiring_faults --out results/wiring.json

serves a policy of madviz's behind each fault, and without one, and writes the whole table.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from websockets.sync.server import ServerConnection

from madviz.envs.registry import env_spec
from madviz.measure.episodes import one_thread
from madviz.measure.wiring.check import WiringFile, wiring
from madviz.policies.checkpoint import load_policy
from madviz.policies.seeds import FIRST_TRY
from madviz.types import Array, Policy
from madviz.wire.reference import with_wire
from tests.wires import foreign_server, wiring_file

POLICY = "metaworld-hammer-merged-only-light"
TOY = "madviz.examples.own_policy:make"
"""A policy that minds which camera is which; the other one sums their features, whoever sent
them."""
MIDDLING = 1.4
"""Standard deviation of noise on the actions, with which ``TOY`` succeeds about half the time."""
RUNS = 20
Pictures = dict[str, Array]


@dataclass(frozen=True)
class Fault:
    """How a server takes a look and gives an answer, and a file that does not say so."""

    right: tuple[str, ...]
    """The lines of a wire file that mend it: any of these."""
    file: dict[str, str]
    pictures: Callable[[Pictures], Pictures] = lambda pictures: pictures
    state: Callable[[Array], Array] = lambda state: state
    action: Callable[[Array], Array] = lambda action: action
    policy: str = POLICY


def each(change: Callable[[Array], Array]) -> Callable[[Pictures], Pictures]:
    """``change`` (H, W, 9) of every picture."""
    return lambda pictures: {name: change(picture) for name, picture in pictures.items()}


def swapped(pictures: Pictures) -> Pictures:
    return {**pictures, "first": pictures["third_a"], "third_a": pictures["first"]}


def from_unit(picture: Array) -> Array:
    return np.clip(picture.astype(np.float32) * 255, 0, 255).round().astype(np.uint8)


def blue_first(picture: Array) -> Array:
    return picture.reshape(*picture.shape[:2], -1, 3)[..., ::-1].reshape(picture.shape)


GRIPPER_FIRST = [start + i for start in range(0, 24, 4) for i in (3, 0, 1, 2)]
FAULTS: dict[str, Fault] = {
    "upside down": Fault(('flip = "upside-down"',), {}, each(lambda p: p[::-1])),
    "mirrored": Fault(('flip = "mirrored"',), {}, each(lambda p: p[:, ::-1])),
    "BGR": Fault(('channels = "bgr"',), {}, each(blue_first)),
    "two cameras swapped": Fault(
        ('cameras = { "first" = "third_a", "third_a" = "first", "third_b" = "third_b" }',),
        {},
        swapped,
        policy=TOY,
    ),
    "0-1 for 0-255": Fault(('values = "0-1"',), {}, each(from_unit)),
    "stretched 4:3": Fault(
        (
            "size = 84\nletterbox = false\nstretch = false",
            "letterbox = false\nstretch = true",
        ),
        {"size": "[63, 84]", "letterbox": "true"},
    ),
    "half the size": Fault(("size = 84",), {"size": "42"}),
    "state columns permuted": Fault(
        (f"state_order = {GRIPPER_FIRST}",), {}, state=lambda s: s[np.argsort(GRIPPER_FIRST)]
    ),
    "state in other units": Fault(("state_scale = 1000.0",), {}, state=lambda s: s / 1000),
    "action sign of one axis": Fault(
        ("action_sign = [1, -1, 1, 1]",), {}, action=lambda a: a * [1, -1, 1, 1]
    ),
    "action scale": Fault(("action_scale = 10.0",), {}, action=lambda a: a / 10),
    "gripper inverted": Fault(("gripper_inverted = true",), {}, action=lambda a: a * [1, 1, 1, -1]),
}
NONE = Fault((), {}, policy=TOY)


@contextmanager
def misunderstood(policy: Policy, fault: Fault, folder: Path, noise: float = 0.0) -> Iterator[str]:
    """The reference of ``policy``, served with ``fault`` to a file in ``folder``. ``noise`` on its
    actions is the same for the same look."""
    streams = policy.spec.streams
    state_dim = env_spec(policy.spec.task).state_dim

    def answer(look: dict[str, Any], connection: ServerConnection) -> dict[str, Any] | None:
        if len(look["state"]) != state_dim:
            connection.close(1011, "another state")
            return None
        pictures = {name: cv2_sized(p) for name, p in fault.pictures(look["images"]).items()}
        views = np.stack([pictures[name].transpose(2, 0, 1) for name in streams])
        state = np.asarray(fault.state(look["state"]), np.float32)
        with one_thread():
            encoded = policy.encode(np.ascontiguousarray(views), state)
            action = policy.read(encoded, np.ones((1, len(streams)), bool)).action[0]
        rng = np.random.default_rng(zlib.crc32(look["images"][streams[0]].tobytes()))
        return {"actions": fault.action(action + rng.normal(0, noise, action.shape))}

    cameras = "{ " + ", ".join(f'{name} = "{name}"' for name in streams) + " }"
    said = {
        "task": f'"{policy.spec.task}"',
        "cameras": cameras,
        "masks": "false",
        "protocol": '"vla-eval"',
        "frames": str(policy.spec.frame_stack),
        **fault.file,
    }
    with foreign_server(answer) as address:
        yield with_wire(address, wiring_file(folder, **said))


def cv2_sized(picture: Array, size: int = 84) -> Array:
    """(H, W, 9) -> (84, 84, 9), stretched, as most servers do."""
    if picture.shape[:2] == (size, size):
        return picture
    frames = [picture[..., i : i + 3] for i in range(0, picture.shape[-1], 3)]
    return np.concatenate([cv2.resize(np.ascontiguousarray(f), (size, size)) for f in frames], -1)


def said_of(
    policy: Policy, fault: Fault, seed: int, noise: float = 0.0
) -> tuple[WiringFile, float]:
    """What ``madviz wiring`` says, and how many seconds of a core it took, with
    the server's."""
    with (
        tempfile.TemporaryDirectory() as folder,
        misunderstood(policy, fault, Path(folder), noise) as reference,
    ):
        start = time.process_time()
        found = wiring(load_policy(reference), seed, progress=True)  # type: ignore[arg-type]
        return found, time.process_time() - start


def judged(found: WiringFile, fault: Fault) -> str:
    """``right``, ``cannot tell`` or ``wrong``."""
    advice = [row["lines"] for row in found["changes"] if row["verdict"] == "helps"]
    if advice:
        return "right" if advice[0] in fault.right else "wrong"
    return "right" if not fault.right and found["verdict"] != "cannot tell" else "cannot tell"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=list(FAULTS))
    parser.add_argument("--runs", type=int, nargs="*", default=list(range(RUNS)))
    arguments = parser.parse_args()
    rows = json.loads(arguments.out.read_text()) if arguments.out.exists() else []
    cases = [(name, FAULTS[name], 0.0, FIRST_TRY) for name in arguments.only]
    cases += [("none", NONE, MIDDLING, FIRST_TRY + 100 * i) for i in arguments.runs]
    for name, fault, noise, seed in cases:
        if any((row["fault"], row["seed"]) == (name, seed) for row in rows):
            continue
        found, seconds = said_of(load_policy(fault.policy), fault, seed, noise)
        rows.append(
            {
                "fault": name,
                "policy": fault.policy,
                "seed": seed,
                "judged": judged(found, fault),
                "verdict": found["verdict"],
                "sentence": found["sentence"],
                "as_wired": [found["successes"], found["n"]],
                "core_seconds": round(seconds),
                "played": [row for row in found["changes"] if row["n"]],
            }
        )
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n")
        print(f"{name:24} {seed} {rows[-1]['judged']:12} {seconds:4.0f} s", found["sentence"])


if __name__ == "__main__":
    main()
