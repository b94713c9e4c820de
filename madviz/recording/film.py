"""``madviz record --vs POLICY``: two policies on the same episodes, as a film for a talk.

Every seed is a chapter. With ``--acts`` a seed has three: all cameras, the failures of ``--drop``,
and the same failures with a guard. X.mp4 is 1920 by 1080 pixels; X.webp is small, for a README.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.measure.statistics import SuccessRate
from madviz.measure.store import Store
from madviz.measure.table import Table
from madviz.observation.condition import Condition
from madviz.observation.schedule import Event, Schedule
from madviz.policies import checkpoint
from madviz.policies.guarded import with_guard
from madviz.recording.film_files import LargeFilm, SmallFilm
from madviz.recording.film_picture import FilmSide, whole_picture
from madviz.recording.frames import frames
from madviz.recording.scene_view import KeepsActions
from madviz.session.commands import Compare, SetSchedule
from madviz.session.ending import RateOf, ending_of
from madviz.session.frame import Frame
from madviz.session.session import Session
from madviz.types import Environment, EnvSpec, PolicySpec

HOLD_FIRST = 1.5
HOLD_LAST = 5.0
"""Seconds for which the first and the last picture of a chapter stay."""


@dataclass(frozen=True)
class Chapter:
    """One episode under both policies."""

    title: str
    seed: int
    schedule: Schedule
    guard: bool
    """True where both policies are guarded."""


def chapters(
    env: EnvSpec, seeds: range, schedule: Schedule, acts: bool, guard: bool
) -> list[Chapter]:
    """The episodes of a film. Raises UserError for acts without failures."""
    failing = ", ".join(_words(event, env) for event in schedule)
    if not acts:
        title = (failing or "All cameras") + (", with the guard" if guard else "")
        return [Chapter(title, seed, schedule, guard) for seed in seeds]
    if not schedule:
        raise UserError(
            "expected failures for the second act, found none; add --drop, as in first=black@0"
        )
    return [
        chapter
        for seed in seeds
        for chapter in (
            Chapter("1 of 3: all cameras", seed, (), False),
            Chapter(f"2 of 3: {failing}", seed, schedule, False),
            Chapter(f"3 of 3: {failing}, with the guard", seed, schedule, True),
        )
    ]


def _words(event: Event, env: EnvSpec) -> str:
    """``First person sends black from step 20``."""
    does = "is dropped" if event.dropped else event.occlusion.predicate
    does = "works again" if event.works else does
    return f"{env.camera(event.camera).label} {does} from step {event.step}"


def known_as(spec: PolicySpec) -> str:
    """A policy's digest, as trainings of one kind share a name; its name where it has none."""
    return spec.digest or spec.name


def known_rates(references: dict[str, str]) -> RateOf:
    """The known rates of policies: from their own evaluation, or from ``madviz eval`` here, which
    of both has more episodes. ``references``: by ``known_as`` of a policy, that for
    ``load_policy``."""

    store = Store()

    def rate(spec: PolicySpec, condition: Condition) -> SuccessRate:
        reference = references.get(known_as(spec), "")  # None of a guarded policy.
        table = Table(reference, spec, store)
        found = SuccessRate.counted(table.outcomes(condition).values())
        measured = (
            checkpoint.shipped_evaluation(reference) if checkpoint.is_folder(reference) else None
        )
        row = (measured or {"subsets": {}})["subsets"].get(condition.subset)
        if row is None or condition.key() or row["n"] < found.n:
            return found
        return SuccessRate.of(round(row["success"] * row["n"]), row["n"])

    return rate


def played(chapter: Chapter, policies: Sequence[str], made: list[KeepsActions]) -> Iterator[Frame]:
    """The frames of a chapter's comparison; both environments are added to ``made``."""
    named = [with_guard(policy, chapter.guard) for policy in policies]

    def watched(*world: Any) -> Environment:
        made.append(KeepsActions(make_env(*world)))
        return made[-1]  # type: ignore[return-value]  # What it lacks is its environment's.

    session = Session(watched, named[0], checkpoint.load_policy, seed=chapter.seed, speed=None)
    session.send(Compare(named[1]))
    session.send(SetSchedule(chapter.schedule))
    with closing(session):
        for frame in frames(session, None):
            if frame.second is not None:
                yield frame


class ChapterRow(TypedDict):
    """How an episode of a film ended."""

    title: str
    seed: int
    success: list[bool]
    """One for each policy."""
    words: str


def write_film(
    path: Path, fps: float, parts: list[Chapter], policies: Sequence[str]
) -> list[ChapterRow]:
    """Writes a film of ``parts`` under two policies, as ``load_policy`` knows them. Raises
    UserError where they have no task in common, and where one or an environment stops."""
    specs = {reference: checkpoint.load_policy(reference).spec for reference in policies}
    tasks = [spec.task for spec in specs.values()]
    if len(set(tasks)) > 1:
        raise UserError(
            f"--vs: expected a policy for {tasks[0]}, found one for {tasks[1]}; choose two of one "
            "task"
        )
    rates = known_rates({known_as(spec): reference for reference, spec in specs.items()})
    film = SmallFilm(path) if path.suffix == ".webp" else LargeFilm(path, fps)
    rows: list[ChapterRow] = []
    titles: list[tuple[float, str]] = []
    with ExitStack() as scenes:
        sides: list[FilmSide] = []
        for part in parts:
            titles.append((film.seconds, f"{part.title}, seed {part.seed}"))
            made: list[KeepsActions] = []
            for frame in played(part, policies, made):
                both = [frame, *([frame.second] if frame.second else [])]
                first = frame.world.step == 0
                sides = sides or [scenes.enter_context(closing(FilmSide(one))) for one in both]
                if first:
                    for side in sides:
                        side.begin(part.seed)
                ending = str(ending_of(frame, rates) or "")
                halves = [
                    side.picture(one, env.actions[: one.world.step])
                    for side, one, env in zip(sides, both, made, strict=True)
                ]
                lasts = HOLD_FIRST if first else HOLD_LAST if frame.ended else 1 / fps
                film.add(whole_picture(frame, halves, part.title, ending), lasts)
                if frame.ended:
                    success = [one.world.success for one in both]
                    rows.append(
                        ChapterRow(title=part.title, seed=part.seed, success=success, words=ending)
                    )
    film.close(titles)
    return rows
