"""Figures of lesson 8: saliency, feature norms, Shapley values, an episode as a file.

An episode is played once and stored as a list of moments; everything here is computed from that
list, so that the simulator runs once for all figures. 100 moments of three cameras are 20 MB.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from madviz.analysis import shapley
from madviz.analysis.saliency import Target, saliency
from madviz.analysis.shapley import ShapleyValues, action_shapley, success_interval
from madviz.drawing.colours import MERGED_ON_WHITE, colours_on_white, heat
from madviz.errors import UserError
from madviz.measure.statistics import wilson
from madviz.plots.figures import curves
from madviz.recording.record import RecordConfig, run_record
from madviz.subsets import camera_of, mask_of
from madviz.teaching import Moment, frames_of
from madviz.teaching.names import named
from madviz.teaching.show import Figure, Picture, TextTable, sheet, table


def saliency_sheet(
    moment: Moment, subset: str = "all", target: Target = "action", size: int = 168
) -> Picture:
    """The newest frame of every stream, dark where ``target`` does not depend on it.

    Raises UserError for a policy without torch networks, and for a subset it cannot act on.
    """
    streams = moment.policy.spec.streams
    mask = mask_of(subset, streams)
    maps = saliency(moment.policy, moment.stack, moment.state, mask, target)
    if maps is None:
        raise UserError(f"{moment.policy.spec.name} has no saliency for {subset!r}; try 'all'")
    pictures = {}
    for index, stream in enumerate(streams):
        grey = frames_of(moment.stack, index)[-1].mean(2, keepdims=True)  # (H, W, 1)
        strength = np.sqrt(maps[index])  # (H, W); the root lets weak places show.
        weight = 0.15 + 0.85 * strength[..., None]  # (H, W, 1)
        mixed = weight * heat(strength) + (1 - weight) * 0.5 * grey  # (H, W, 3)
        pictures[named(stream)] = mixed.astype(np.uint8)
    return sheet(pictures, size)


def norm_curves(episode: Sequence[Moment]) -> Figure:
    """The norm of every stream's feature over an episode, and of their sum."""
    series: dict[str, list[float]] = {}
    for index, stream in enumerate(episode[0].policy.spec.streams):
        series[stream] = [float(moment.probe.norms[index]) for moment in episode]
    series["sum"] = [moment.probe.merged_norm(0) for moment in episode]
    return _drawn("norm of the features", series, episode)


def shapley_curves(episode: Sequence[Moment]) -> Figure:
    """Shapley values of the cameras for the action, over an episode: by how much each brings it
    nearer to the action on all."""
    streams = episode[0].policy.spec.streams
    values = [action_shapley(moment.probe, streams).cameras for moment in episode]
    cameras = dict.fromkeys(map(camera_of, streams))
    series = {name: [float(value[i]) for value in values] for i, name in enumerate(cameras)}
    return _drawn("Shapley values for the action", series, episode)


def _drawn(title: str, series: Mapping[str, Sequence[float]], episode: Sequence[Moment]) -> Figure:
    own = colours_on_white(episode[0].env.cameras)
    colours = {named(name): own.get(camera_of(name), MERGED_ON_WHITE) for name in series}
    lines = {named(name): values for name, values in series.items()}
    return Figure(curves(title, lines, colours, {}, episode[-1].step, height=180), title)


def success_shapley(
    measured: Mapping[str, tuple[int, int]], streams: tuple[str, ...]
) -> tuple[ShapleyValues, TextTable]:
    """Shapley values of the cameras for the success rate, which was counted for every subset of
    them: the numbers, and a table with their intervals. Raises UserError where one is missing."""
    rates = {name: successes / n for name, (successes, n) in measured.items()}
    values = shapley.success_shapley(rates, streams)
    if values is None:
        raise UserError(
            "expected success for every subset of the cameras; measure the missing ones"
        )
    bounded = {name: (rates[name], *wilson(*counted)) for name, counted in measured.items()}
    low, high = success_interval(bounded, streams)
    cameras = dict.fromkeys(map(camera_of, streams))
    rows = [
        [named(name), f"{values.cameras[i]:+.2f}", f"[{low[i]:+.2f}, {high[i]:+.2f}]"]
        for i, name in enumerate(cameras)
    ]
    rows.append(["together", f"{float(values.cameras.sum()):+.2f}", ""])
    return values, table(["camera", "Shapley value", "95% interval"], rows)


@dataclass(frozen=True)
class Report:
    """A page in one file, shown inside the notebook; it loads nothing from elsewhere."""

    page: str
    height: int = 620

    def __repr__(self) -> str:
        return "[a report of an episode]"

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{escape(self.page)}" width="100%" height="{self.height}" '
            'style="border:1px solid #ccc"></iframe>'
        )


def record(policy: str, folder: Path, seed: int = 2000, drop: Sequence[str] = ()) -> Path:
    """Records an episode for rerun's viewer, cameras dropped when ``drop`` says (``third_a@20``);
    the file."""
    file = folder / f"{policy}-{seed}.rrd"
    run_record(RecordConfig(file, policy, seed, tuple(drop)))
    return file


def report(policy: str, folder: Path, seed: int = 2000, drop: Sequence[str] = ()) -> Report:
    """The same as a report of one page."""
    file = folder / f"{policy}-{seed}.html"
    run_record(RecordConfig(file, policy, seed, tuple(drop)))
    return Report(file.read_text())
