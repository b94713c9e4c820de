"""The grammar of camera failures: one grammar for ``eval --occlude``, ``record --drop`` and the
page.

    camera[=what][@from[-to]]

    third_a                 dropped for the whole episode
    third_a@20              dropped from step 20 on
    third_a@20-40           dropped at step 20, back at step 40
    third_a=black@20        occluded: it stays in the sum, and sends black
    first=noise:0.5@10-18   noise of strength 0.5 for 8 decisions
    first=patch:1:0.3:0.5:0.4:0.2
                            a patch of strength 1; its middle from the left and the top, its width
                            and its height follow, as shares of the picture

An older spelling, ``first=noise,strength=0.5``, is still read, with a line that names the new one.

A *condition*, for a comparison, is a subset of cameras or a failure for the whole episode, or
several of those with commas: ``all``, ``first+third_b``, ``third_a=black``, ``all=noise:0.5``,
``first=off,third_a=black``; or a camera that stands elsewhere, ``third_a.pan=-11``. A step at the
end is where all of it begins: ``first=freeze@20``, ``third_a=black,first=off@20``; a subset has
none, because ``first@20`` is a dropped camera above. The words of page and audit are read, too
(lossy, late, frozen), and so is an order with the failure first: ``late:first``,
``noise:all:0.5``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from madviz.errors import UserError, unknown
from madviz.observation.ablation import KINDS, PLACE, Occlusion, by_sides
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement
from madviz.subsets import camera_of, cameras_of, mask_of
from madviz.system.streams import say

SAME = {"dropped": "off", "frozen": "freeze", **{row.button: kind for kind, row in KINDS.items()}}
"""The words of audit and page."""
DROPPED = "off"
"""The word for a dropped camera: ``third_a@20`` is short for ``third_a=off@20``."""
HOW = "camera@step, camera@from-to or camera=black@step, for example third_b=noise:0.5@10-30"
_FAILURE = re.compile(r"(\w+)(?:=([a-z]+[\d.:]*))?(?:@(\d{1,6})(?:-(\d{1,6}))?)?")
_MOVED = re.compile(r"(\w+)\.(forward|right|up|pan|tilt|zoom)=(-?\d+(?:\.\d*)?)")
_OLD = re.compile(r"(\w+)=([a-z]+)((?:,[a-z]+=[\d.]+)+)")


@dataclass(frozen=True)
class CameraFailure:
    """One camera that fails: dropped, or occluded."""

    camera: str
    occlusion: Occlusion | None
    """None: dropped."""
    begin: int = 0
    """Step from which it fails."""
    end: int | None = None
    """Step at which it works again; None: never."""

    def __post_init__(self) -> None:
        if self.end is not None and self.end <= self.begin:
            raise UserError(
                f"expected a failure that ends after step {self.begin}, found {self.end}: swap them"
            )


def parse_failure(word: str) -> CameraFailure:
    """``first=noise:0.5@10-18`` and the other forms of the module. Raises UserError."""
    if old := _OLD.fullmatch(word):
        return _old_spelling(word, *old.groups())
    match = _FAILURE.fullmatch(word)
    if match is None:
        raise UserError(f"expected a failure such as {HOW}; found {word!r:.60}")
    camera, what, begin, end = match.groups()
    return CameraFailure(
        camera, parse_what(what or DROPPED), int(begin or 0), int(end) if end else None
    )


def parse_what(what: str) -> Occlusion | None:
    """``off`` (None), ``kind``, ``kind:strength`` or, of a patch,
    ``kind:strength:x:y:width:height``. Raises UserError."""
    kind, *numbers = what.split(":")
    kind = SAME.get(kind, kind)
    if kind == DROPPED and not numbers:
        return None
    known: dict[str, tuple[str, ...]] = {n: row.uses for n, row in KINDS.items() if n != "none"}
    if kind not in known:
        raise unknown("failure", kind, [DROPPED, *known])
    uses = known[kind]
    if numbers and not uses:
        raise UserError(f"expected {kind!r} alone, for it has no strength; found {what!r:.60}")
    if len(numbers) not in (0, 1, len(uses)):
        raise UserError(
            f"expected a strength after {kind!r}, and of a patch its {', '.join(PLACE)}, as in "
            f"patch:1:0.3:0.5:0.4:0.2; found {what!r:.60}"
        )
    shares = [_share(number, f"after {kind!r}") for number in numbers]
    return Occlusion(kind, *shares)  # type: ignore[arg-type]


def parse_occlusions(words: Iterable[str]) -> dict[str, Occlusion]:
    """Occlusions by camera for whole episodes, as an evaluation has them. Raises UserError, also
    for cameras that are dropped and for failures that begin or end in mid-episode."""
    occlusions = {}
    for word in words:
        failure = parse_failure(word)
        if failure.occlusion is None:
            raise UserError(
                f"expected an occlusion such as first=noise:0.5, found {word!r}, a dropped camera; "
                "leave it out of --subsets instead"
            )
        if "@" in word:
            raise UserError(
                f"expected a failure for whole episodes, found steps in {word!r}; leave out what "
                "follows the @, or use madviz compare --conditions or record --drop"
            )
        if failure.camera in occlusions:
            raise UserError(
                f"expected every camera occluded once, found {failure.camera!r} twice; drop one"
            )
        occlusions[failure.camera] = failure.occlusion
    return occlusions


def parse_condition(word: str, cameras: Sequence[str]) -> Condition:
    """``all``, ``first+third_b``, ``third_a=black`` and the other forms of the module, as it was
    written (see ``Condition.noticed``). Raises UserError, also for a subset beside a dropped
    camera, for a failure or a move of a camera that the subset leaves out, and for an axis that is
    given twice."""
    subsets: list[str] = []
    failing: list[str] = []
    dropped: list[str] = []
    occlusions: dict[str, Occlusion] = {}
    moves: dict[str, Displacement] = {}
    axes: set[tuple[str, str]] = set()
    parts, begin = _beginning(word)
    for part in parts.split(","):
        if moved := _MOVED.fullmatch(part):
            name, axis, value = moved.groups()
            if name not in cameras:
                raise unknown(f"camera in the condition {word!r:.60}:", name, list(cameras))
            if (name, axis) in axes:
                raise UserError(f"expected {name}.{axis} once in a condition, found {word!r:.60}")
            axes.add((name, axis))
            moves[name] = replace(moves.get(name, Displacement()), **{axis: float(value)})
            continue
        if "=" in part or ":" not in part:
            what, _, strength = part.partition("=")[2].partition(":")
            name = part.partition("=")[0]
        else:
            what, _, rest = part.partition(":")
            name, _, strength = rest.partition(":")
        if not what:
            subsets.append(part)
            continue
        occlusion = parse_what(f"{what}:{strength}" if strength else what)
        if name not in (*cameras, "all"):
            raise unknown(f"camera in the condition {word!r:.60}:", name, [*cameras, "all"])
        if occlusion is not None:
            failing.append(name)
        for camera in cameras if name == "all" else (name,):
            if camera in dropped or camera in occlusions:
                raise UserError(f"expected {camera!r} once in a condition, found {word!r:.60}")
            if occlusion is None:
                dropped.append(camera)
            else:
                occlusions[camera] = occlusion
    if len(subsets) + bool(dropped) > 1:
        raise UserError(
            f"expected one subset of cameras, found {word!r:.60}; write those that are present"
        )
    present = "+".join(camera for camera in cameras if camera not in dropped) or "none"
    subset = subsets[0] if subsets else present if dropped else "all"
    _check_present(word, subset, [*failing, *moves], cameras)
    if begin and (moves or subsets):
        found = "one that is moved" if moves else f"the subset {subsets[0]!r}"
        raise UserError(
            f"condition {word!r:.60}: expected cameras that are dropped or fail at step {begin}, "
            f"as in first=off,third_a=black@{begin}, found {found}; write so, or leave out the @"
        )
    return Condition(subset, tuple(occlusions.items()), tuple(moves.items()), begin)


def condition_text(condition: Condition, streams: tuple[str, ...]) -> str:
    """The condition in the grammar again, as briefly as it can be said, of a policy with
    ``streams``."""
    parts = [] if condition.subset == "all" else [condition.subset]
    if condition.begin:
        mask = mask_of(condition.subset, streams)
        present = {camera_of(name) for name, on in zip(streams, mask, strict=True) if on}
        gone = [camera for camera in cameras_of(streams) if camera not in present]
        parts = [f"{camera}={DROPPED}" for camera in gone]
    parts += [failure_text(camera, occlusion) for camera, occlusion in condition.occlusions]
    for camera, move in condition.moves:
        parts += [f"{camera}.{name}={value:g}" for name, value in move.changed.items()]
    return (",".join(parts) or "all") + (f"@{condition.begin}" if condition.begin else "")


def _beginning(word: str) -> tuple[str, int]:
    """A condition without its step, and the step. Raises UserError for a step that is none."""
    parts, at, step = word.partition("@")
    if at and not re.fullmatch(r"\d{1,6}", step):
        raise UserError(
            f"condition {word!r:.60}: expected one step, at its end, as in first=freeze@20 or "
            f"third_a=black,first=off@20; found {at + step!r:.40}"
        )
    return parts, int(step or 0)


def _check_present(word: str, subset: str, names: Sequence[str], cameras: Sequence[str]) -> None:
    """Raises UserError where a camera of ``names`` is not in ``subset``: nothing would happen."""
    words = {camera_of(name.strip()) for name in subset.split("+")}
    if words & {"all", "rgb", "depth"}:
        return
    for name in names:
        if not words & ({*cameras} if name == "all" else {name}):
            raise UserError(
                f"condition {word!r:.60}: expected a camera that is present to fail or to move, "
                f"found {name!r}, which {subset!r:.60} leaves out; add it to the subset, or leave "
                "out what happens to it"
            )


def failure_text(camera: str, occlusion: Occlusion | None, begin: int | None = None) -> str:
    """The failure in the grammar again, as briefly as it can be said; without ``begin``, for the
    whole episode."""
    what = "" if occlusion is None else f"={_what_text(occlusion)}"
    return f"{camera}{what}" + ("" if begin is None else f"@{begin}")


def _what_text(occlusion: Occlusion) -> str:
    occlusion = occlusion.effective  # Without what a slider of another kind was left at.
    numbers = "" if occlusion.strength == 1 else f":{occlusion.strength:g}"
    place = [round(getattr(occlusion, name), 3) for name in PLACE]
    if occlusion.kind == "patch" and place != [getattr(Occlusion(), name) for name in PLACE]:
        numbers = f":{occlusion.strength:g}:" + ":".join(f"{value:g}" for value in place)
    return occlusion.kind + numbers


def _old_spelling(word: str, camera: str, kind: str, details: str) -> CameraFailure:
    """``first=patch,x=0.2,size=0.3``. Raises UserError."""
    pairs = [detail.split("=") for detail in details.split(",")[1:]]
    try:
        values = by_sides({name: float(value) for name, value in pairs})
        occlusion = Occlusion(kind, **values)  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise UserError(f"expected a failure such as {HOW}; found {word!r:.60}: {error}") from error
    new = failure_text(camera, occlusion)
    say(f"note: {word!r} is an older spelling, write {new!r}")
    return CameraFailure(camera, occlusion)


def _share(word: str, where: str) -> float:
    """A number in [0, 1]. Raises UserError for anything else."""
    if not re.fullmatch(r"[01](\.\d{1,6})?|\.\d{1,6}", word) or float(word) > 1:
        raise UserError(f"expected a number from 0 to 1 {where}, found {word!r:.20}")
    return float(word)
