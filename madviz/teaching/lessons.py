"""One function for each thing that a lesson draws or counts; the words are in the notebooks.

They take moments, policies or counts and return what draws itself (``madviz.teaching.show``), so
that a cell is one line and a widget can show its result, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import get_args

import numpy as np
import torch

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.merges.table import MERGES
from madviz.agent.methods import METHODS, method
from madviz.agent.networks import NetworkConfig
from madviz.drawing.colours import heat
from madviz.errors import UserError
from madviz.evaluation.evaluate import evaluate
from madviz.evaluation.mean_picture import mean_pictures
from madviz.evaluation.statistics import wilson
from madviz.observation.ablation import Occlusion, OcclusionKind, noise_generator
from madviz.observation.streams import depth_code
from madviz.subsets import every_mask, name_of
from madviz.teaching import Moment, counts, frames_of, moments
from madviz.teaching.show import MARK, Figure, Picture, TextTable, bars, presence, sheet, table
from madviz.types import Array, Policy, PolicySpec

# The input of a policy.


def camera_sheet(moment: Moment, modality: str = "rgb", size: int = 168) -> Picture:
    """What every camera really sees: colour, or depth from near (dark) to far (bright)."""
    shown = {}
    for name, view in moment.views.items():
        camera = moment.env.camera(name)
        depth = depth_code(view.depth, camera.depth_range)[..., 0] / 255
        shown[camera.label] = view.rgb if modality == "rgb" else heat(depth)
    return sheet(shown, size)


def stack_sheet(moment: Moment, stream: str = "first", size: int = 168) -> Picture:
    """The frames of one stream, oldest first, and what changed between the last two."""
    frames = frames_of(moment.stack, moment.policy.spec.streams.index(stream))
    shown = {f"{stream}, {len(frames) - 1 - i} ago": frame for i, frame in enumerate(frames)}
    change = np.abs(frames[-1].astype(int) - frames[-2]).mean(2)
    shown["what changed"] = heat(change / max(change.max(), 1))
    return sheet(shown, size)


def feature_sheet(moment: Moment, size: int = 168) -> Picture:
    """The 3136 numbers of every stream's feature as a square of 56 x 56, on one colour scale."""
    features = moment.probe.features
    side = int(np.sqrt(features.shape[1]))
    if side * side != features.shape[1]:
        raise UserError(f"expected a square number of features, found {features.shape[1]}")
    top = float(np.quantile(features, 0.995)) or 1.0
    squares = features.reshape(-1, side, side) / top
    names = moment.policy.spec.streams
    return sheet({n: heat(np.sqrt(s)) for n, s in zip(names, squares, strict=True)}, size)


def state_table(moment: Moment, words: Sequence[str] = ()) -> TextTable:
    """The proprioceptive numbers, with ``words`` for the first of them."""
    rows = [
        [index, words[index] if index < len(words) else "", f"{value:+.3f}"]
        for index, value in enumerate(moment.state)
    ]
    return table(["number", "meaning", "value"], rows)


def occlusion_sheet(moment: Moment, camera: str = "first", size: int = 140) -> Picture:
    """One camera under every occlusion; ``freeze``, ``dropout`` and ``delay`` show the oldest frame
    of the stack, which differs a little where something moves."""
    frame = moment.views[camera].rgb
    before = frames_of(moment.stack, moment.policy.spec.streams.index(camera))[0]
    shown = {}
    for kind in get_args(OcclusionKind):
        occlusion, rng = Occlusion(kind), noise_generator(0, moment.step, camera)
        seen = before if occlusion.late else frame
        if kind == "mean":
            seen = mean_pictures(moment.env, moment.policy.spec.streams)[camera]
        shown[kind] = occlusion.apply(seen, before, rng)
    return sheet(shown, size, columns=4)


# Features and actions.


def subset_table(moment: Moment, every: bool = True) -> TextTable:
    """Norm of the merged feature, action and Q under every subset (or the trained ones)."""
    probe, spec = moment.probe, moment.policy.spec
    rows = []
    for row, mask in enumerate(probe.masks):
        name = name_of(mask, spec.streams)
        if (every or name in spec.trained_subsets) and probe.supported[row]:
            action = " ".join(f"{a:+.2f}" for a in probe.readout.action[row])
            trained = name in spec.trained_subsets
            merged, q = probe.merged_norm(row), float(probe.readout.q[row])
            rows.append([name, int(mask.sum()), trained, merged, action, q])
    return table(["cameras", "views", "trained", "norm of M", "action", "Q"], rows)


def norm_bars(moment: Moment) -> Figure:
    """The norm of every subset's merged feature, relative to the largest."""
    probe, streams = moment.probe, moment.policy.spec.streams
    norms = [probe.merged_norm(row) for row in range(len(probe.masks))]
    groups = [name_of(mask, streams) for mask in probe.masks]
    values = [norm / max(norms) for norm in norms]
    return bars("norm of M, relative to the largest", groups, {"this time step": values})


def norms_by_views(policy: Policy, seeds: Sequence[int], every: int = 5) -> dict[int, list]:
    """Number of views -> norms of the merged feature over subsets, episodes and every fifth
    decision."""
    found: dict[int, list[float]] = {}
    for seed in seeds:
        for moment in moments(policy, seed):
            if moment.step % every == 0:
                for row, mask in enumerate(moment.probe.masks):
                    found.setdefault(int(mask.sum()), []).append(moment.probe.merged_norm(row))
    return dict(sorted(found.items()))


def count_views(known: Mapping[int, list], asked: Mapping[int, list]) -> tuple[int, int]:
    """How often the nearest mean norm in ``known`` gives the number of views in ``asked``:
    (hits, tries). Zero views are left out: their sum is always 0."""
    means = {views: float(np.mean(norms)) for views, norms in known.items() if views}
    tries = [(views, norm) for views, norms in asked.items() if views for norm in norms]
    hits = sum(min(means, key=lambda v: abs(means[v] - norm)) == views for views, norm in tries)
    return hits, len(tries)


def action_gaps(policy: Policy, seed: int, subsets: Sequence[str]) -> dict[str, float]:
    """Mean distance over an episode between the action on all streams and on each of ``subsets``,
    at the same time steps; the policy acts on all streams."""
    gaps: dict[str, list[float]] = {name: [] for name in subsets}
    for moment in moments(policy, seed):
        for name in subsets:
            gaps[name].append(float(np.linalg.norm(moment.action(name) - moment.action("all"))))
    return {name: float(np.mean(values)) for name, values in gaps.items()}


# Success.


def measure(
    policy: Policy,
    subsets: Sequence[str],
    episodes: int,
    seed: int = 5000,
    occlusions: Mapping[str, Occlusion] | None = None,
) -> dict[str, tuple[int, int]]:
    """Subset -> (successes, episodes), run now, in this process."""
    result = evaluate(
        policy, subsets, episodes=episodes, seed=seed, workers=0, occlusions=dict(occlusions or {})
    )
    return counts(result.rows)


def interval_figure(successes: int = 8, n: int = 10) -> Figure:
    """One rate with its interval, beside the same rate from ten times as many episodes."""
    successes = min(successes, n)
    series = {"success": [(successes, n), (10 * successes, 10 * n)]}
    return bars(f"{successes} of {n}", [f"n = {n}", f"n = {10 * n}"], series)


def width_table(rate: float, episodes: Sequence[int]) -> TextTable:
    """How wide Wilson's interval is around ``rate`` for several numbers of episodes."""
    rows = []
    for n in episodes:
        low, high = wilson(round(rate * n), n)
        rows.append([n, f"[{low:.2f}, {high:.2f}]", high - low])
    return table(["episodes", "95% interval", "width"], rows)


# Other methods.


def untrained(name: str, streams: tuple[str, ...] = ("first", "third_a", "third_b")) -> TorchPolicy:
    """A policy of the method ``name`` for ``toy/reach`` that has learned nothing: its shape shows
    which subsets it can act on, and its numbers mean nothing."""
    chosen = method(name)
    streams = streams[:1] if chosen.one_camera else streams
    spec = PolicySpec(
        name=f"toy-reach-{name}-untrained",
        task="toy/reach",
        method=name,
        setting="three",
        recipe="none",
        streams=streams,
        trained_subsets=chosen.trained_subsets(streams),
    )
    config = NetworkConfig(state_dim=6, action_dim=2, hidden_dim=64, bottleneck_dim=64)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return TorchPolicy(spec, Agent(config, merge=chosen.merge, streams=streams))


def support_table(streams: tuple[str, ...] = ("first", "third_a", "third_b")) -> TextTable:
    """Which subsets every method can act on, from its merge."""
    masks = every_mask(len(streams))
    rows = []
    for name, chosen in METHODS.items():
        if chosen.one_camera:
            marks = [MARK[0] if mask.sum() == 0 or not mask[0] else MARK[1] for mask in masks]
            rows.append([name, *marks, "its one camera (here first) and nothing else"])
        else:
            allowed = MERGES[chosen.merge].support.allows
            marks = [MARK[int(allowed(mask))] for mask in masks]
            rows.append([name, *marks, chosen.summary])
    return table(["method", *(presence(mask, streams) for mask in masks), "what it is"], rows)


def answers(policy: Policy, moment: Moment, subsets: Sequence[str]) -> TextTable:
    """The action of ``policy`` on each of ``subsets`` at one time step, or why it refuses."""
    encoded = policy.encode(moment.stack, moment.state)
    rows = []
    for name in subsets:
        mask = np.array([part in name.split("+") for part in policy.spec.streams])
        mask = np.ones_like(mask) if name == "all" else mask
        try:
            action: Array = policy.read(encoded, mask[None]).action[0]
            rows.append([name, " ".join(f"{a:+.2f}" for a in action)])
        except UserError as error:
            rows.append([name, f"refuses: {error}"])
    return table(["cameras", "answer"], rows)
