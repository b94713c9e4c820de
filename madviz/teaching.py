"""What the notebooks share, so that a cell of theirs is a question and a line or two of code.

A lesson mostly needs one thing: a *moment*, that is one instant of one episode as a policy meets
it. ``moments`` plays an episode and yields them; ``moment_at`` goes straight to one:

    policy = madviz.load_policy("metaworld-hammer-mad-light")
    now = moment_at(policy, seed=2000, step=20)
    now.views["first"].rgb     (84, 84, 3)   what the camera sees
    now.stack                  (V, 9, 84, 84) what the network gets
    now.probe.norms            (V,)          the length of every camera's feature

Trainings of a lesson are real ones on ``toy/reach`` with small numbers (``train_small``), or of the
light recipe's own size on any task (``train_light``). Both keep them in a folder and do not train
again what is there already.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from madviz import checkpoint
from madviz.ablations import Ablation, Occlusion, noise_generator
from madviz.envs.base import make_env
from madviz.probes import Probe, probe
from madviz.statistics import pair, wilson
from madviz.streams import StreamStack
from madviz.subsets import camera_of, cameras_of, mask_of
from madviz.teaching_show import Figure, Table, Words, bars, table
from madviz.types import Array, EnvSpec, Policy, PolicySpec, UserError, View

if TYPE_CHECKING:
    from madviz.recipes.light import LightConfig

LESSON_SEED = 2000
"""Moments of lessons are taken from here: no training saw these episodes, no card reports them."""


def begin() -> None:
    """The first line of a lesson: pictures without a display, one thread for small networks.

    MuJoCo reads ``MUJOCO_GL`` while it is imported, and its own default needs a display.
    """
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")
    import torch

    torch.set_num_threads(1)


@dataclass(frozen=True)
class Moment:
    """One instant of an episode, and what ``policy`` makes of it."""

    policy: Policy
    env: EnvSpec
    views: dict[str, View]
    """What each camera really sees."""
    arrived: dict[str, Array]
    """(H, W, C) uint8 by stream: what reached the policy, occlusions applied."""
    stack: Array
    """(V, 3 x frame stack, H, W) uint8: the network's input, oldest frame first."""
    state: Array
    """(S,) float32 proprioception."""
    step: int
    success: bool
    """The task's condition at this very step."""

    @cached_property
    def probe(self) -> Probe:
        """Features, and what every subset of them would do."""
        return probe(self.policy, self.policy.encode(self.stack, self.state))

    def row(self, subset: str) -> int:
        """The row of ``subset`` in ``probe``. Raises UserError for unknown words."""
        return self.probe.row(mask_of(subset, self.policy.spec.streams))

    def action(self, subset: str = "all") -> Array:
        """(A,) what the policy would do next if it had ``subset``."""
        return self.probe.readout.action[self.row(subset)]


def moments(
    policy: Policy,
    seed: int = LESSON_SEED,
    subset: str = "all",
    occlusions: Mapping[str, Occlusion] | None = None,
) -> Iterator[Moment]:
    """Plays the episode ``seed`` with the cameras of ``subset``, and yields every instant, the last
    one included. All cameras are drawn, so that a lesson can show what was not used.

    Raises UserError for unknown words and for a subset the policy cannot act on.
    """
    begin()
    spec = policy.spec
    mask = mask_of(subset, spec.streams)
    if not policy.supports(mask):
        raise UserError(f"{spec.name} cannot act on {subset!r}; pick a subset it supports")
    ablation = Ablation.from_mask(mask, spec.streams, dict(occlusions or {}))
    with closing(make_env(spec.task, spec.render_profile, spec.cameras)) as env:
        stack = StreamStack(env.spec, spec.streams, spec.frame_stack)
        now, step = env.reset(seed), 0
        while True:
            views = {camera: env.view(camera) for camera in cameras_of(spec.streams)}
            stack.push(views, ablation, seed, step)
            moment = Moment(
                *(policy, env.spec, views, dict(stack.newest), stack.views),
                *(np.asarray(now.state, np.float32), step, now.success),
            )
            yield moment
            if now.last:
                return
            encoded = policy.encode(moment.stack, moment.state)
            now, step = env.step(policy.read(encoded, mask[None]).action[0]), step + 1


def moment_at(
    policy: Policy,
    seed: int = LESSON_SEED,
    step: int = 20,
    subset: str = "all",
    occlusions: Mapping[str, Occlusion] | None = None,
) -> Moment:
    """The instant after ``step`` decisions. Raises UserError for a step beyond the episode."""
    for moment in moments(policy, seed, subset, occlusions):
        if moment.step == step:
            return moment
    raise UserError(f"expected a step of the episode, found {step}; it is over before that")


def occluded(moment: Moment, occlusions: Mapping[str, Occlusion]) -> Moment:
    """The same instant as if cameras had failed for as long as the network looks back, and nothing
    had come of it yet. A frozen camera shows the oldest frame of the stack, and so does a late one:
    older frames are not there."""
    stack, streams = moment.stack.copy(), moment.policy.spec.streams
    for index, stream in enumerate(streams):
        occlusion = occlusions.get(camera_of(stream), Occlusion())
        frames = frames_of(moment.stack, index)
        failed = [
            occlusion.apply(
                frames[max(place - occlusion.late, 0)],
                frames[0],
                noise_generator(0, moment.step + place, stream),
            )
            for place in range(len(frames))
        ]
        stack[index] = np.concatenate([np.moveaxis(frame, -1, 0) for frame in failed])
    newest = {stream: frames_of(stack, index)[-1] for index, stream in enumerate(streams)}
    return replace(moment, stack=stack, arrived=newest)


def frames_of(stack: Array, stream: int) -> list[Array]:
    """The colour frames (H, W, 3) of one stream in a stack (V, C, H, W), oldest first."""
    return [np.moveaxis(part, 0, -1) for part in np.split(stack[stream], len(stack[stream]) // 3)]


def in_words(successes: int, n: int) -> Words:
    """``8 of 10 = 0.80, 95% interval [0.49, 0.94]``."""
    low, high = wilson(successes, n)
    rate = successes / n if n else float("nan")
    return Words(f"{successes} of {n} = {rate:.2f}, 95% interval [{low:.2f}, {high:.2f}]")


def counts(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, tuple[int, int]]:
    """Subset -> (successes, episodes), from the rows of an evaluation or of evaluation.json."""
    return {name: (round(row["success"] * row["n"]), row["n"]) for name, row in rows.items()}


def shipped(policy: str) -> dict[str, tuple[int, int]]:
    """Subset -> (successes, episodes) of a policy's evaluation.json: measured before, not here.

    Raises UserError where the policy has none.
    """
    found = checkpoint.shipped_evaluation(checkpoint.find_policy(policy))
    if found is None:
        raise UserError(f"{policy}: expected an evaluation.json; make one: madviz eval --card")
    return counts(found["subsets"])


def shipped_outcomes(policy: str, subset: str) -> dict[int, bool]:
    """Seed -> success of a policy's evaluation.json, for ``statistics.pair``."""
    found = checkpoint.shipped_evaluation(checkpoint.find_policy(policy)) or {"episodes": []}
    return {e["seed"]: e["success"] for e in found["episodes"] if e["subset"] == subset}


def shipped_on(task: str) -> dict[str, dict[str, tuple[int, int]]]:
    """Policy -> its shipped counts, for all that ship for ``task`` with three colour cameras."""
    found = {}
    for name, folder in sorted(checkpoint.policy_folders().items()):
        spec = checkpoint.describe(folder).spec
        if spec.task == task and spec.setting == "three" and checkpoint.shipped_evaluation(folder):
            found[name] = shipped(name)
    return found


def success_table(measured: Mapping[str, Mapping[str, tuple[int, int]]]) -> Table:
    """A row per subset, and for each of ``measured`` its rate, interval and count."""
    names = dict.fromkeys(name for one in measured.values() for name in one)
    rows = []
    for name in names:
        cells = []
        for one in measured.values():
            if name in one:
                low, high = wilson(*one[name])
                rate = one[name][0] / one[name][1]
                cells.append(f"{rate:.2f} [{low:.2f}, {high:.2f}] n={one[name][1]}")
            else:
                cells.append("not measured")
        rows.append([name, *cells])
    return table(["cameras", *measured], rows)


def success_bars(title: str, measured: Mapping[str, Mapping[str, tuple[int, int]]]) -> Figure:
    """Success by subset, with Wilson intervals; only subsets that all of ``measured`` have."""
    first, *others = measured.values()
    groups = [name for name in first if all(name in other for other in others)]
    series = {name: [one[group] for group in groups] for name, one in measured.items()}
    return bars(title, groups, series)


def paired_table(
    names: tuple[str, str], outcomes: Mapping[str, tuple[Mapping[int, bool], Mapping[int, bool]]]
) -> Table:
    """Two policies on the scenes that both met (seed -> success, twice), a row for each subset:
    how they came out, and the difference of their rates with its interval."""
    rows = []
    for subset, (first, second) in outcomes.items():
        met = pair(first, second)
        low, high = met.interval()
        difference = f"{met.difference:+.2f} [{low:+.2f}, {high:+.2f}] n={met.n}"
        counted = (met.both, met.first_only, met.second_only, met.neither)
        rows.append([subset, *counted, difference])
    only = [f"only {name}" for name in names]
    return table(["cameras", "both", *only, "neither", " - ".join(names)], rows)


@dataclass(frozen=True)
class SmallRun:
    """A training of a lesson."""

    folder: Path
    policy: Policy
    seconds: float
    """Wall time; 0 where it was there already."""
    curve: tuple[Mapping[str, Any], ...]
    """One row per round, as in curve.csv."""

    @property
    def spec(self) -> PolicySpec:
        return self.policy.spec


def train_small(
    method: str,
    *,
    rounds: int = 8,
    updates: int = 100,
    critic: int = 100,
    camera: str = "",
    task: str = "toy/reach",
    folder: Path | str | None = None,
    seed: int = 1,
) -> SmallRun:
    """Trains ``method`` with the light recipe and small numbers: about a minute on ``toy/reach``.

    ``rounds`` of ``updates`` shape what the policy does, ``critic`` updates the Q it shows. For the
    rest see ``train_light``.
    """
    from madviz.recipes.light import LightConfig

    light = LightConfig(rounds=rounds, updates_per_round=updates, batch_size=32, hidden_dim=128)
    light = replace(light, critic_updates=critic)
    return train_light(task, method, light, camera=camera, folder=folder, seed=seed)


def train_light(
    task: str,
    method: str,
    light: LightConfig | None = None,
    *,
    camera: str = "",
    folder: Path | str | None = None,
    seed: int = 1,
) -> SmallRun:
    """Trains with the light recipe, as ``madviz train`` does; ``light`` None is its own size.

    A run that is there already is loaded and not repeated, and one that was interrupted goes on.
    ``folder`` is where runs are kept, by default a temporary one of this user. Raises UserError for
    unknown names, and where the training is stopped before its end.
    """
    from madviz.recipes.light import LightConfig
    from madviz.sweep.run import trained
    from madviz.train import TrainConfig, train

    begin()
    light = light or LightConfig()
    config = TrainConfig(task=task, method=method, camera=camera, seed=seed, light=light)
    root = Path(folder) if folder else Path(tempfile.gettempdir()) / "madviz-lessons"
    own = sha256(repr(light).encode()).hexdigest()[:6]
    out = root / f"{config.policy_name()}-{light.rounds}x{light.updates_per_round}-{own}-{seed}"
    began, done = time.monotonic(), trained(out)
    if not done:
        resume = (out / "resume" / "run.json").exists()
        train(replace(config, out=out, resume=resume), _say)
        if not trained(out):
            raise UserError(
                "expected a finished training, found one that was stopped; "
                "run the cell again, and it goes on where it was"
            )
    seconds = 0.0 if done else time.monotonic() - began
    return SmallRun(out, checkpoint.load_policy(out), seconds, _read_curve(out / "curve.csv"))


def _say(event: dict[str, Any]) -> None:
    """One line that grows, so that a class sees the training go on."""
    if event["kind"] == "curve":
        minutes = round(event["seconds_left"] / 60)
        left = f" ({minutes} min to go)" if minutes > 1 else ""
        print(f"round {event['round']}: loss {event['loss']:.3f}{left}", end="  ", flush=True)


def _read_curve(file: Path) -> tuple[Mapping[str, Any], ...]:
    import csv

    with file.open(newline="") as handle:
        return tuple(
            {key: float(v or "nan") for key, v in row.items()} for row in csv.DictReader(handle)
        )
