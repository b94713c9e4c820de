"""How far a policy acts from the expert on fixed states, under each change of its wire file.

    6 scenes, 4 looks each    the expert drives, with noise, so that states off its way occur, too
    distance                  of an action's numbers from the expert's, in [-1, 1], on average

Changes of the action words alone need no new question. The best change of each kind goes on, at
most three, and those alone that are clearly closer than the file as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from madviz.envs.checks import expert_action
from madviz.errors import UserError
from madviz.measure.wiring.candidates import Candidate
from madviz.observation.ablation import Ablation
from madviz.observation.streams import StreamStack
from madviz.subsets import cameras_of
from madviz.types import Array, Environment, PolicySpec
from madviz.wire.conventions import Conventions
from madviz.wire.policy import ServedPolicy
from madviz.wire.reference import rewired
from madviz.wire.wiring import Wiring

SCENES = 6
LOOKS = (0.0, 0.1, 0.25, 0.4)
"""Shares of the horizon after which the expert's scene is looked at."""
NOISE = 0.3
"""Standard deviation of what is added to the expert's actions."""
FIRST_LOOKS = 4
"""Looks of every change, one scene; the best of each kind get the others."""
BEST = 3
"""How many of a kind these are."""
CLOSER = 0.9
"""The distance of a change that goes on, as a share of that as wired, at most."""
MOST = 3
"""Changes that go on to episodes."""
ACTION_WORDS = ("action_order", "action_sign", "action_scale", "gripper_inverted", "absolute")


@dataclass(frozen=True)
class ExpertLook:
    """One state of a scene."""

    views: dict[int, Array]
    """By rows and columns of a picture, (V, C, H, W) uint8."""
    state: Array
    """(S,)."""
    action: Array
    """(A,) in [-1, 1], the expert's."""


@dataclass(frozen=True)
class Screened:
    """A change, and how far from the expert the policy acts with it."""

    candidate: Candidate
    distance: float
    """Infinite where the server refused."""
    looks: int
    """Looks that were asked about."""
    refused: str = ""
    """The server's refusal in words."""


def expert_looks(
    env: Environment, spec: PolicySpec, sizes: set[int], seed: int
) -> list[ExpertLook]:
    """The looks of the scenes from ``seed`` on, one scene after the other, drawn with each of
    ``sizes``."""
    scenes = range(seed, seed + SCENES)
    return [look for one in scenes for look in _looks(env, spec, sizes, one, env.spec.horizon)]


def _looks(
    env: Environment, spec: PolicySpec, sizes: set[int], scene: int, length: int
) -> list[ExpertLook]:
    """Those of one scene, of ``length`` decisions. One that ends earlier is played again, so that
    all of its looks are from before its end."""
    steps = [round(share * length) for share in LOOKS]
    found = []
    noise = np.random.default_rng(scene)
    now = env.reset(scene)
    stacks: dict[int, StreamStack] = {}
    for step in range(max(steps) + 1):
        last = min((each for each in steps if each >= step), default=step)
        if step in (0, max(last - spec.frame_stack + 1, 0)):
            stacks = {
                size: StreamStack(env.spec, spec.streams, spec.frame_stack, size) for size in sizes
            }
        if last - step < spec.frame_stack:
            for size, stack in stacks.items():
                views = {camera: env.view(camera, size) for camera in cameras_of(spec.streams)}
                stack.push(views, Ablation(), scene, step)
        action = np.clip(expert_action(env), -1, 1)
        if step in steps:
            pictures = {size: stack.views for size, stack in stacks.items()}
            found.append(ExpertLook(pictures, now.state, action))
        now = env.step(np.clip(action + noise.normal(0, NOISE, action.shape), -1, 1))
        if now.last and step < max(steps):
            return _looks(env, spec, sizes, scene, step + 1)
    return found


class Screening:
    """Asks the server about the looks; every question once."""

    def __init__(self, policy: ServedPolicy, looks: list[ExpertLook]) -> None:
        self._policy = policy
        self._looks = looks
        self._answers: dict[bytes, list[Array]] = {}

    def distance(self, wiring: Wiring, looks: int) -> float:
        """The mean distance from the expert over the first ``looks``. Raises UserError where the
        server refuses."""
        policy = rewired(self._policy, wiring)
        answers = self._asked(wiring, looks)
        found = []
        for look, answer in zip(self._looks[:looks], answers, strict=False):
            action = np.clip(policy.own_action(answer, look.state), -1, 1)
            found.append(np.abs(action - look.action).mean())
        return float(np.mean(found))

    def _asked(self, wiring: Wiring, looks: int) -> list[Array]:
        """The server's answers, (A,) each, before the words for actions."""
        plain = {f.name: f.default for f in msgspec.structs.fields(Conventions)}
        plain |= {"action_order": [], "action_sign": []}
        question = msgspec.structs.replace(wiring, **{name: plain[name] for name in ACTION_WORDS})
        answers = self._answers.setdefault(msgspec.json.encode(question), [])
        policy = rewired(self._policy, question)
        mask = np.ones(len(policy.spec.streams), bool)
        try:
            for look in self._looks[len(answers) : looks]:
                encoded = policy.encode(look.views[wiring.largest], look.state)
                answers.append(policy.first_answer(encoded, mask))
        finally:
            policy.close()
        return answers


def screened(screen: Screening, tried: list[Candidate]) -> list[Screened]:
    """Every change with its distance; the ``BEST`` of each kind over all looks, the others over the
    first ones."""
    by_kind: dict[str, list[Screened]] = {}
    for candidate in tried:
        result = _measured(screen, candidate, FIRST_LOOKS)
        by_kind.setdefault(candidate.kind, []).append(result)
    found = []
    for results in by_kind.values():
        results.sort(key=_rank)
        best = [r.candidate for r in results[:BEST] if not r.refused]
        found += [_measured(screen, candidate, SCENES * len(LOOKS)) for candidate in best]
        found += results[len(best) :]
    return found


def _measured(screen: Screening, candidate: Candidate, looks: int) -> Screened:
    try:
        return Screened(candidate, screen.distance(candidate.wiring, looks), looks)
    except UserError as error:
        return Screened(candidate, float("inf"), looks, str(error))


def _rank(result: Screened) -> float:
    """To two places: changes that are as close stay in the order of ``candidates``, where the
    simpler one comes first. A state that hardly changes has many orders that are alike."""
    return round(result.distance, 2)


def going_on(results: list[Screened], as_wired: float) -> list[Screened]:
    """The best change of each kind that is clearly closer to the expert, at most ``MOST``."""
    best: dict[str, Screened] = {}
    for result in sorted(results, key=_rank):
        if result.looks > FIRST_LOOKS and result.distance <= CLOSER * as_wired:
            best.setdefault(result.candidate.kind, result)
    return list(best.values())[:MOST]
