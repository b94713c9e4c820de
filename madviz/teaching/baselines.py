"""What lesson 6 measures: MAD and nine baselines, small on ``toy/reach``, without some cameras.

A camera can be missing in one of two ways. It is *dropped*: the merge does without it. Or it *sends
black*, and the policy takes that for its picture. A merge that has a place for every camera (pixels
or features side by side) knows the second way only. So each method is measured in the same cases:

    all                 what it was trained for
    third_a dropped     two cameras are left, where its merge allows that
    third_a black       three arrive, one of them black
    only third_a        one is left, where its merge allows that

Ten trainings take longer than a lesson, so ``notebooks/baselines.py`` made them once and saved the
outcomes, an episode a digit, seeds counting from 5000. Any two methods can therefore be compared
episode by episode: "1101" and "1100" differ in the last of four.

    {"seed": 5000, "methods": {"vib": {"all": "1101...", "third_a black": "0100...", ...}}, ...}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from madviz.agent.agent import TorchPolicy
from madviz.agent.merges.attention import HEADS, CrossAttention, attend
from madviz.agent.merges.mvd import drawn
from madviz.agent.merges.vit import ViewTransformer
from madviz.errors import UserError
from madviz.evaluation.evaluate import FIRST_SEED, evaluate
from madviz.evaluation.evidence import find_evidence
from madviz.evaluation.statistics import SuccessRate
from madviz.observation.ablation import Occlusion
from madviz.policies import checkpoint
from madviz.report.layouts import BASELINES
from madviz.report.tables import build
from madviz.subsets import mask_of
from madviz.system.files import read_json, write_json
from madviz.teaching import Moment, SmallRun, train_small
from madviz.teaching.show import Figure, TextTable, bars, table
from madviz.types import Array, Policy

CAMERAS = ("first", "third_a", "third_b")
COMPARED = (
    "mad",
    "merged-only",
    "q-mean",
    "attention",
    "vit",
    "mvd",
    "vib",
    "concat",
    "frame-stack",
    "single",
)
"""Methods in the order of the tables."""
ROUNDS, UPDATES = 6, 100
"""Of every training, as in lesson 3."""
EPISODES = 40
"""Of every case."""

Outcomes = Mapping[str, str]
"""Case -> a digit for each episode, 1 for success; a case that the policy refuses is missing."""


def cases() -> dict[str, tuple[tuple[str, ...], str]]:
    """Name of a case -> the cameras that are left, and the one of them that sends black."""
    return {
        "all": (CAMERAS, ""),
        **{f"{name} dropped": (tuple(c for c in CAMERAS if c != name), "") for name in CAMERAS},
        **{f"{black} black": (CAMERAS, black) for black in CAMERAS},
        **{f"only {camera}": ((camera,), "") for camera in CAMERAS},
    }


def train_baseline(name: str) -> SmallRun:
    """The small training of one method: ``single`` learns from Third A, the others from all."""
    camera = "third_a" if name == "single" else ""
    return train_small(name, camera=camera, rounds=ROUNDS, updates=UPDATES)


def run_cases(
    policy: Policy,
    names: Sequence[str] = (),
    episodes: int = EPISODES,
    seed: int = FIRST_SEED,
) -> dict[str, str]:
    """Case -> outcomes of those called ``names`` (all of them if there are none), run in this
    process. A camera that the policy never had changes nothing, and nothing is run twice."""
    known = cases()
    found: dict[str, str] = {}
    ran: dict[tuple[str, str], str] = {}
    for name in names or known:
        cameras, black = known[name]
        left = [camera for camera in cameras if camera in policy.spec.streams]
        subset, black = "+".join(left), black if black in left else ""
        if not left or not policy.supports(mask_of(subset, policy.spec.streams)):
            continue
        if (subset, black) not in ran:
            occlusions = {black: Occlusion("black")} if black else {}
            result = evaluate(
                policy, [subset], episodes=episodes, seed=seed, workers=0, occlusions=occlusions
            )
            ran[subset, black] = "".join(str(int(one.success)) for one in result.episodes)
        found[name] = ran[subset, black]
    return found


# Saved outcomes.


def save_outcomes(file: Path, method: str, outcomes: Outcomes) -> None:
    """Puts the outcomes of ``method`` into ``file``, beside those of other methods."""
    found = {**(read_outcomes(file) if file.exists() else {}), method: dict(outcomes)}
    methods = {name: found[name] for name in COMPARED if name in found}
    budget = {"rounds": ROUNDS, "updates": UPDATES}
    write_json(file, {"task": "toy/reach", **budget, "seed": FIRST_SEED, "methods": methods})


def read_outcomes(file: Path | str) -> dict[str, dict[str, str]]:
    """Method -> outcomes, as ``notebooks/baselines.py`` measured them."""
    return read_json(Path(file))["methods"]


def one_missing(measured: Mapping[str, Outcomes]) -> dict[str, dict[str, str]]:
    """The outcomes of each method with one camera missing, in the way that suits it: dropped where
    its merge can do without, else black. The cases are called ``first missing`` and so on."""
    found = {}
    for name, outcomes in measured.items():
        found[name] = {"all": outcomes["all"]}
        for camera in CAMERAS:
            black = outcomes[f"{camera} black"]
            found[name][f"{camera} missing"] = outcomes.get(f"{camera} dropped", black)
    return found


def counted(measured: Mapping[str, Outcomes], case: str) -> dict[str, tuple[int, int]]:
    """Method -> (successes, episodes) in ``case``, of those methods that do not refuse it."""
    return {
        name: (outcomes[case].count("1"), len(outcomes[case]))
        for name, outcomes in measured.items()
        if case in outcomes
    }


def by_seed(outcomes: str) -> dict[int, bool]:
    """Digits -> success by seed, for ``statistics.pair`` and ``teaching.paired_table``."""
    return {FIRST_SEED + index: digit == "1" for index, digit in enumerate(outcomes)}


def outcome_table(
    measured: Mapping[str, Outcomes], names: Sequence[str], missing: str = "refuses"
) -> TextTable:
    """A row per method, and its success in each case with interval and count; ``missing`` says why
    there may be none."""
    rows = []
    for method, outcomes in measured.items():
        found = [outcomes.get(name, "") for name in names]
        cells = [str(SuccessRate.of(o.count("1"), len(o))) if o else missing for o in found]
        rows.append([method, *cells])
    return table(["method", *names], rows)


def on_robot(task: str) -> dict[str, dict[str, str]]:
    """Method -> outcomes with all cameras and with each alone, of the trainings of ``task`` that
    were measured before and are comparable: one recipe, one budget, the same seeds. Single Camera
    is a training per camera and has none with all."""

    layout = replace(BASELINES, needs=2)
    for root in checkpoint.policy_roots():
        evidence, _ = find_evidence(root, checkpoint.results_beside(root))
        for found in build(layout, [each for each in evidence if each.config.task == task]):
            return {
                row.label: {
                    column: "".join(str(int(success)) for _, success in sorted(cell.items()))
                    for column, cell in row.cells.items()
                }
                for _, row in found.rows
            }
    return {}


def outcome_bars(title: str, measured: Mapping[str, Outcomes], names: Sequence[str]) -> Figure:
    """Success by method with a bar for each case; no bar where the method refuses."""
    counts = {name: counted(measured, name) for name in names}
    return bars(
        title, list(measured), {name: [counts[name].get(m) for m in measured] for name in names}
    )


# How they do it.


def attention_shares(policy: TorchPolicy, moment: Moment, subset: str) -> TextTable:
    """Which share of its attention each present view gives to each view under ``subset``, a mean
    over heads and places; from the network's own queries and keys.

    Raises UserError for a policy without attention.
    """
    net = policy.agent.encoder
    if not isinstance(net, CrossAttention | ViewTransformer):
        raise UserError(f"expected a policy that attends, found {policy.spec.name}")
    outputs: dict[str, torch.Tensor] = {}

    def store(name: str):
        return lambda module, inputs, output: outputs.__setitem__(name, output)

    hooks = [getattr(net, n).register_forward_hook(store(n)) for n in ("query", "key")]
    streams = policy.spec.streams
    mask = mask_of(subset, streams)
    policy.read(policy.encode(moment.stack, moment.state), mask[None])
    for hook in hooks:
        hook.remove()
    shares = _shares(outputs["query"], outputs["key"], mask, isinstance(net, ViewTransformer))
    rows = [[name, *shares[i]] for i, name in enumerate(streams) if mask[i]]
    return table(["attends to", *streams], rows)


def _shares(query: torch.Tensor, key: torch.Tensor, mask: Array, itself: bool) -> Array:
    """(1, T, D) twice, (V,) -> (V, V) shares, zeros where no view may be attended to. The values
    are replaced by the one-hot index of their view, so that the outputs are the shares."""
    views, tokens = len(mask), query.shape[1]
    places = tokens // views
    who = np.tile(mask, (views, 1)) & (itself | ~np.eye(views, dtype=bool))
    allowed = torch.from_numpy(who.repeat(places, 0).repeat(places, 1))
    query, key = (x.unflatten(-1, (HEADS, -1)).transpose(1, 2) for x in (query, key))
    one_hot = torch.eye(views).repeat_interleave(places, 0).expand(1, HEADS, -1, -1)
    shares = attend(query, key, one_hot, allowed)[0].unflatten(-1, (HEADS, views)).mean(1)
    return shares.unflatten(0, (views, places)).mean(1).numpy() * who.any(1, keepdims=True)


def averaged_heads(policy: TorchPolicy, moment: Moment) -> TextTable:
    """Q-mean's actions on single cameras, their mean taken before tanh, and its action on all."""
    now = replace(moment, policy=policy)
    alone = np.stack([now.action(name) for name in policy.spec.streams])
    mean = np.tanh(np.arctanh(alone.astype(float)).mean(0))
    rows = [[f"only {n}", _numbers(a)] for n, a in zip(policy.spec.streams, alone, strict=True)]
    rows += [["mean of the three", _numbers(mean)], ["all", _numbers(now.action())]]
    return table(["cameras", "action"], rows)


def put_everywhere(policy: TorchPolicy, moment: Moment, camera: str) -> TextTable:
    """VIB's action on ``camera`` alone, and on three cameras that all send its picture."""
    index = policy.spec.streams.index(camera)
    thrice = policy.encode(moment.stack[[index] * len(moment.stack)], moment.state)
    everything = policy.read(thrice, np.ones((1, len(moment.stack)), bool)).action[0]
    rows = [
        [f"only {camera}", _numbers(replace(moment, policy=policy).action(camera))],
        [f"three times {camera}", _numbers(everything)],
    ]
    return table(["what arrives", "action"], rows)


def same_draws(draws: int, seed: int = 0) -> tuple[int, int]:
    """How often MVD's draw is the same with Third A as without: (times, draws)."""
    masks = torch.from_numpy(np.stack([mask_of(s, CAMERAS) for s in ("all", "first+third_b")]))
    generator = torch.Generator().manual_seed(seed)
    keys = torch.rand(draws, 2, len(CAMERAS), generator=generator)
    same = [bool((pairs[:, 0] == pairs[:, 1]).all()) for pairs in (drawn(masks, k) for k in keys)]
    return sum(same), draws


def _numbers(action: Array) -> str:
    return " ".join(f"{a:+.2f}" for a in action)
