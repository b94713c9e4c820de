"""Show me: an episode that turned, beside the one that it is compared with.

A rate says how often; a pair shows what happens. Both episodes are of one seed. They are played
again, which gives the same episodes to the bit for a policy that repeats itself. Those of a policy
that does not were kept (``watched.py``). A pair without films, or with another outcome than was
counted, is left out, and the page says how many were.

The actions part at the first step from which they differ for ``STEPS`` steps by more than ``FAR``
of the spread of the first episode's actions. Up to there both robots do the same.
"""

from __future__ import annotations

import shlex
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path

import numpy as np

from madviz.measure.attention import places_html
from madviz.measure.blocks import Block, html
from madviz.measure.episodes import Job, Runner
from madviz.measure.watched import FPS, GAP, RATE, WatchedEpisode, kept, watched
from madviz.observation.grammar import condition_text
from madviz.plots.figures import curves
from madviz.policies import checkpoint
from madviz.subsets import cameras_of
from madviz.system.files import write_bytes
from madviz.system.mp4 import REPEATABLE, Mp4
from madviz.types import Array

MOST = 12
"""Pairs on a page."""
STEPS = 3
FAR = 0.1
BAR = 8
"""Pixels of the time line above it."""
MARK = (184, 134, 11)


@dataclass(frozen=True)
class EpisodePair:
    """Two episodes of one seed."""

    first: Job
    second: Job
    labels: tuple[str, str]
    """The words for each: ``all cameras`` and ``First person dropped``."""
    successes: tuple[bool, bool]
    """The outcomes that were measured."""


@dataclass(frozen=True)
class ShownPair:
    """A pair with its two episodes."""

    pair: EpisodePair
    first: WatchedEpisode
    second: WatchedEpisode

    @property
    def distances(self) -> Array:
        """(T,): how far the actions are apart, in spreads of the first episode's."""
        steps = min(len(self.first.actions), len(self.second.actions))
        first, second = (np.stack(one.actions[:steps]) for one in (self.first, self.second))
        spread = float(np.sqrt(((first - first.mean(0)) ** 2).sum(-1).mean()))
        return np.linalg.norm(first - second, axis=-1) / max(spread, 1e-9)

    @property
    def parts(self) -> int | None:
        """The step at which the actions part; None where they do not."""
        return parting(self.distances)


def parting(distances: Array) -> int | None:
    """The first of ``STEPS`` steps in a row whose distance is above ``FAR``; None for none."""
    far = np.asarray(distances) > FAR
    runs = np.convolve(far, np.ones(STEPS), "valid") == STEPS if len(far) >= STEPS else far[:0]
    return int(np.argmax(runs)) if runs.any() else None


def show(pairs: Sequence[EpisodePair], runner: Runner) -> list[ShownPair]:
    """The pairs with their episodes, kept or played again; those that have none, or whose
    outcomes are others now, are left out."""
    known: dict[Job, WatchedEpisode | None] = {}
    for job in dict.fromkeys(pair.first for pair in pairs):
        known[job] = kept(job) if job.kept else watched(job, runner, looks=True)[0]
    for job in dict.fromkeys(pair.second for pair in pairs):
        if job not in known:
            known[job] = kept(job) if job.kept else watched(job, runner)[0]
    shown = []
    for pair in pairs:
        first = known[pair.first]
        second = known[pair.second]
        if first and second and pair.successes == (first.success, second.success):
            shown.append(ShownPair(pair, first, second))
    return shown


def film(shown: ShownPair) -> bytes:
    """An MP4 file: a time line on which the step is marked at which the actions part, the first
    episode, and the second under it. The shorter one holds its last picture."""
    rows = shown.first.pictures, shown.second.pictures
    steps = max(map(len, rows))
    width = rows[0][0].shape[1]
    file = BytesIO()
    written = Mp4(file, FPS, RATE, REPEATABLE)  # An audit that goes on gives the same page.
    for step in range(steps):
        line = np.full((BAR, width, 3), 60, np.uint8)
        line[:, : round(width * (step + 1) / steps)] = 150
        if shown.parts is not None:
            place = round((width - 4) * shown.parts / steps)
            line[:, place : place + 4] = MARK
        above, below = (row[min(step, len(row) - 1)] for row in rows)
        gap = np.full((GAP, width, 3), 40, np.uint8)
        written.add(np.concatenate([line, above, gap, below]))
    written.close()
    return file.getvalue()


# --- On a page ---

KEPT = (
    "This policy gives other answers when it is asked again. These are the episodes that were "
    "counted, kept while they were played; the explorer shows another one of the same seed."
)
"""Beside episodes that were kept."""


def pair_blocks(pairs: Sequence[EpisodePair], runner: Runner) -> list[Block]:
    """The part of a page that shows ``pairs``; nothing where there are none."""
    if not pairs:
        return []
    shown = show(pairs, runner)
    blocks = [Block("h2", ["Show me"])]
    if pairs[0].first.kept:
        blocks.append(Block("p", [KEPT]))
    blocks += [Block("raw", [sentence(one), _html(one, runner)]) for one in shown]
    if len(shown) < len(pairs):
        blocks.append(
            Block(
                "p",
                [
                    f"{len(pairs) - len(shown)} of {len(pairs)} pairs are not shown: their "
                    "episodes were not kept, or came out otherwise when they were played again."
                ],
            )
        )
    return blocks


def sentence(shown: ShownPair) -> str:
    """``Seed 60003: success with all cameras, none with First person dropped. …``."""
    pair = shown.pair
    words = ["success" if success else "no success" for success in pair.successes]
    step = shown.parts
    steps = len(shown.distances)
    apart = (
        "Their actions never part for long."
        if step is None
        else f"Their actions part at step {step} of {steps}."
    )
    first, second = pair.labels
    return f"Seed {pair.first.seed}: {words[0]} with {first}, {words[1]} with {second}. {apart}"


def explore_command(job: Job, streams: tuple[str, ...]) -> str:
    """The command that opens the episode of ``job``, of a policy with ``streams``, on the page."""
    words = ["madviz", "explore", "--policy", checkpoint.shown(job.policy or "POLICY")]
    words += ["--seed", str(job.seed), "--condition", condition_text(job.condition, streams)]
    return shlex.join(words)


def _html(shown: ShownPair, runner: Runner) -> str:
    pair = shown.pair
    env, policy = runner.opened(pair.first)
    cameras = cameras_of(policy.spec.streams)
    names = [env.spec.camera(name).label for name in cameras]
    step = shown.parts
    marks = {} if step is None else {step: "the actions part"}
    distances = list(map(float, shown.distances))
    drawn = curves(
        "How far the actions are apart, in spreads",
        {"distance": distances},
        {"distance": "#0b6e99"},
        marks,
        len(distances),
    )
    film_url = "data:video/mp4;base64," + b64encode(film(shown)).decode()
    first, second = (escape(label) for label in pair.labels)
    return (
        f'<details class="pair"><summary>{escape(sentence(shown))}</summary>'
        f"<p>Above: {first}. Under it: {second}. From left to right: {escape(', '.join(names))}. "
        "The mark on the time line is where the actions part.</p>"
        f'<video controls loop muted playsinline preload="metadata" src="{film_url}"></video>'
        f"{drawn}{places_html(shown.first.looks, step, pair.first, runner)}"
        "<p>Open it in the explorer, the same seed and switches:</p>"
        f"<p><code>{escape(explore_command(pair.second, policy.spec.streams))}</code></p></details>"
    )


def turned(
    first: Mapping[int, bool],
    second: Mapping[int, bool],
    jobs: tuple[Callable[[int], Job], Callable[[int], Job]],
    labels: tuple[str, str],
) -> list[EpisodePair]:
    """The pairs whose outcomes differ, those that only the first solves before the others;
    outcomes by seed, and the episode of a seed for each."""
    seeds = sorted(
        (seed for seed in first if first[seed] != second[seed]), key=lambda s: (second[s], s)
    )
    return [
        EpisodePair(jobs[0](seed), jobs[1](seed), labels, (first[seed], second[seed]))
        for seed in seeds
    ]


def in_turns(lists: Sequence[Sequence[EpisodePair]], most: int) -> list[EpisodePair]:
    """At most ``most`` pairs, the first of every list, then the second, and so on."""
    longest = max(map(len, lists), default=0)
    return [one[place] for place in range(longest) for one in lists if place < len(one)][:most]


def write_page(
    file: Path, title: str, text: str, lists: Sequence[Sequence[EpisodePair]], runner: Runner
) -> None:
    """A page with the lines of ``text`` and with pairs of ``lists`` in turn."""
    with closing(runner):
        blocks = [Block("h1", [title]), Block("list", text.splitlines())]
        shown = pair_blocks(in_turns(lists, MOST), runner) or [Block("p", ["No episode turned."])]
        write_bytes(file, html([*blocks, *shown]).encode())
