"""The pictures of the lessons: a function for each picture, figure or table.

They take moments, policies or counts and return what draws itself (``madviz.teaching.show``), so
that a widget can show it, too. What a lesson computes stands in its cells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.merges.merge_table import MERGES, own_options
from madviz.agent.methods import METHODS, method
from madviz.agent.networks import NetworkConfig
from madviz.drawing.colours import heat
from madviz.errors import UserError
from madviz.measure.mean_picture import mean_pictures
from madviz.observation.ablation import KINDS, Occlusion, noise_generator
from madviz.subsets import every_mask, name_of
from madviz.system.depth import depth_code
from madviz.teaching import Moment, frames_of
from madviz.teaching.names import named
from madviz.teaching.show import MARK, Figure, Picture, TextTable, bars, sheet, table
from madviz.types import Array, Policy, PolicySpec

# The input of a policy.


def camera_sheet(moment: Moment, modality: str = "rgb", size: int = 168) -> Picture:
    """The true picture of every camera: colour, or depth from near (dark) to far (bright)."""
    shown = {}
    for name, view in moment.views.items():
        camera = moment.env.camera(name)
        depth = depth_code(view.depth, camera.depth_range)[..., 0] / 255
        shown[camera.label] = view.rgb if modality == "rgb" else heat(depth)
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
    return sheet({named(n): heat(np.sqrt(s)) for n, s in zip(names, squares, strict=True)}, size)


def occlusion_sheet(moment: Moment, camera: str = "first", size: int = 140) -> Picture:
    """One camera under every occlusion; those that send an older picture show the oldest frame
    of the stack, which differs a little where something moves."""
    frame = moment.views[camera].rgb
    before = frames_of(moment.stack, moment.policy.spec.streams.index(camera))[0]
    shown = {}
    for kind in KINDS:
        occlusion = Occlusion(kind)
        rng = noise_generator(0, moment.step, camera)
        seen = before if occlusion.late else frame
        if kind == "mean":
            seen = mean_pictures(moment.env, moment.policy.spec.streams)[camera]
        shown[KINDS[kind].button] = occlusion.apply(seen, before, rng)
    return sheet(shown, size, columns=4)


# Features and actions.


def subset_table(moment: Moment, every: bool = True) -> TextTable:
    """Norm of the merged feature, action and Q under every subset (or the trained ones)."""
    probe = moment.probe
    spec = moment.policy.spec
    rows = []
    for row, mask in enumerate(probe.masks):
        name = name_of(mask, spec.streams)
        if (every or name in spec.trained_subsets) and probe.supported[row]:
            action = " ".join(f"{a:+.2f}" for a in probe.readout.action[row])
            trained = name in spec.trained_subsets
            merged = probe.merged_norm(row)
            q = float(probe.readout.q[row])
            rows.append([named(name), int(mask.sum()), trained, merged, action, q])
    return table(["cameras", "views", "trained", "norm of M", "action", "Q"], rows)


# Success.


def interval_figure(successes: int = 8, n: int = 10) -> Figure:
    """One rate with its interval, beside the same rate from ten times as many episodes."""
    successes = min(successes, n)
    series = {"success": [(successes, n), (10 * successes, 10 * n)]}
    return bars(f"{successes} of {n}", [f"n = {n}", f"n = {10 * n}"], series)


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
    own = own_options(chosen.merge).of_recipe("light")
    config = NetworkConfig(state_dim=6, action_dim=2, hidden_dim=64, own=own)
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
            rows.append([name, *marks, "its one camera (here First person) and nothing else"])
        else:
            allowed = MERGES[chosen.merge].support.allows
            marks = [MARK[int(allowed(mask))] for mask in masks]
            rows.append([name, *marks, chosen.summary])
    subsets = [named(name_of(mask, streams)) for mask in masks]
    return table(["method", *subsets, "what it is"], rows)


def answers(policy: Policy, moment: Moment, subsets: Sequence[str]) -> TextTable:
    """The action of ``policy`` on each of ``subsets`` at one time step, or why it refuses."""
    encoded = policy.encode(moment.stack, moment.state)
    rows = []
    for name in subsets:
        mask = np.array([part in name.split("+") for part in policy.spec.streams])
        mask = np.ones_like(mask) if name == "all" else mask
        try:
            action: Array = policy.read(encoded, mask[None]).action[0]
            rows.append([named(name), " ".join(f"{a:+.2f}" for a in action)])
        except UserError as error:
            rows.append([named(name), f"refuses: {named(str(error))}"])
    return table(["cameras", "answer"], rows)
