"""Ablations, which are all that can happen to cameras: small frozen values.

Two things are easily confused. A *dropped* stream leaves the sum: the policy's merged feature
loses the term f(o_i). An *occluded* stream stays in the sum, but its camera sends black, noise or
an old picture, so that the sum holds f(black), an input nobody trained it on. ``CameraInput``
decides the first, an ``Occlusion`` the second. A third thing is a camera that was *moved*: its
picture is sound, but from elsewhere (``displacement.py``).

Noise and losses are drawn from (seed, step, stream), so a replayed session gives the same pixels.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar, get_args

import cv2
import numpy as np

from madviz.errors import UserError, unknown
from madviz.observation.displacement import Displacement
from madviz.subsets import camera_of, modality_of
from madviz.types import Array

T = TypeVar("T")
CameraInput = Literal["rgb", "depth", "both", "off"]
OcclusionKind = Literal[
    "none", "black", "mean", "noise", "freeze", "blur", "patch", "dropout", "delay", "light"
]
PLACE = ("x", "y", "width", "height")
"""Where a patch is: its middle from the left and the top, and its sides."""
LATEST = 10
"""Decisions by which a delayed picture is late at most; a second at normal speed."""
BRIGHTEST = 2.0
"""Times the light that there is, at strength 1 of ``light``; nothing changes at half."""


@dataclass(frozen=True)
class Occlusion:
    """How a camera fails (see ``KINDS``). All but ``kind`` are fractions in [0, 1]."""

    kind: OcclusionKind = "none"
    strength: float = 1.0
    x: float = 0.5
    y: float = 0.5
    width: float = 0.4
    height: float = 0.4

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise unknown("occlusion", str(self.kind), list(KINDS))
        for name in ("strength", *PLACE):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and 0 <= value <= 1):
                raise UserError(f"{name} of an occlusion must be between 0 and 1, found {value!r}")

    @property
    def late(self) -> int:
        """How many decisions ago what arrives now was seen."""
        return round(LATEST * self.strength) if self.kind == "delay" else 0

    def looks(self, step: int) -> bool:
        """True where the camera's own picture of ``step`` matters, if the occlusion lasts from step
        0 on; otherwise it need not be drawn."""
        if self.kind in ("black", "mean") or (self.kind == "noise" and self.strength == 1):
            return False
        return self.kind != "freeze" or step == 0

    @property
    def predicate(self) -> str:
        """The sentence about a camera, without its name: ``sends 70 % noise``."""
        return self._filled_in(KINDS[self.kind].predicate)

    @property
    def past(self) -> str:
        """The same of an episode that is over: ``sent 70 % noise``."""
        return self._filled_in(KINDS[self.kind].past)

    @property
    def badge(self) -> str:
        """The words on a camera's picture: ``NOISE 70 %``."""
        return self._filled_in(KINDS[self.kind].badge)

    def _filled_in(self, template: str) -> str:
        light = f"{BRIGHTEST * self.strength:.2g}"
        strength = f"{100 * self.strength:.0f} %"
        return template.format(strength=strength, late=self.late, light=light)

    @property
    def effective(self) -> Occlusion:
        """This occlusion with the default for all that its kind does not use: two that do the same
        are equal here, whatever the sliders of another kind were left at. Numbers have six
        digits, as in ``Condition.key``: a slider says 0.30000000000000004 for 0.3."""
        if self.kind == "delay":
            return Occlusion("delay", self.late / LATEST)
        used = {name: round(getattr(self, name), 6) for name in KINDS[self.kind].uses}
        return Occlusion(self.kind, **used)

    def apply(self, frame: Array, before: Array | None, rng: np.random.Generator) -> Array:
        """The frame that arrives instead of ``frame`` (H, W, C) uint8; ``before`` is the one that
        arrived last, None at the first step. Pure: neither input is written to. A ``frame`` that is
        delayed is one of ``late`` decisions ago already, and one that is the mean is the mean
        picture: who keeps frames chooses it."""
        return KINDS[self.kind].arrives(self, frame, before, rng)


def _whole(how: Occlusion, frame: Array, before: Array | None, rng: np.random.Generator) -> Array:
    return frame


def _lost(how: Occlusion, frame: Array, before: Array | None, rng: np.random.Generator) -> Array:
    lost = rng.random() < how.strength
    return before if lost and before is not None else frame


def _blurred(how: Occlusion, frame: Array, before: Array | None, rng: np.random.Generator) -> Array:
    sigma = 8 * how.strength
    blurred = frame if sigma < 0.1 else cv2.GaussianBlur(frame, (0, 0), sigma)
    return np.asarray(blurred).reshape(frame.shape)


def _noisy(how: Occlusion, frame: Array, before: Array | None, rng: np.random.Generator) -> Array:
    noise = rng.integers(0, 256, frame.shape, np.uint8)
    return cv2.addWeighted(frame, 1 - how.strength, noise, how.strength, 0).reshape(frame.shape)


def _lit(how: Occlusion, frame: Array, before: Array | None, rng: np.random.Generator) -> Array:
    if frame.shape[2] == 1:  # Depth is the same in any light.
        return frame
    return cv2.convertScaleAbs(frame, alpha=BRIGHTEST * how.strength)


def _patched(how: Occlusion, frame: Array, before: Array | None, rng: np.random.Generator) -> Array:
    rows = _covered(how.y, how.height, frame.shape[0])
    columns = _covered(how.x, how.width, frame.shape[1])
    patched = frame.copy()
    patched[rows, columns] = frame[rows, columns] * (1 - how.strength)
    return patched


def _covered(middle: float, share: float, count: int) -> slice:
    """The rows, or columns, of ``count`` that a patch covers."""
    return slice(
        round(max(middle - share / 2, 0) * count), round(min(middle + share / 2, 1) * count)
    )


@dataclass(frozen=True)
class Kind:
    """A way in which a camera fails. Page, notebooks, recordings and commands read these rows."""

    button: str
    """Its button on the page; commands know the kind by this word, too."""
    menu: str
    """Its line in a notebook's menu, after the camera's name."""
    predicate: str
    """See ``Occlusion.predicate``. ``{strength}``, ``{late}`` and ``{light}`` are filled in, here
    and below."""
    past: str
    """See ``Occlusion.past``."""
    badge: str = ""
    arrives: Callable[[Occlusion, Array, Array | None, np.random.Generator], Array] = _whole
    """The rule behind ``Occlusion.apply``."""
    uses: tuple[str, ...] = ()
    """The fractions of an ``Occlusion`` that matter; the page has a slider for each."""


_STRENGTH = ("strength",)
KINDS: dict[OcclusionKind, Kind] = {
    "none": Kind("as it is", "sees", "sends its picture again", "sent its picture"),
    # Every pixel is 0.
    "black": Kind(
        "black",
        "sends black",
        "sends black",
        "sent black",
        "BLACK",
        lambda _, frame, *__: np.zeros_like(frame),
    ),
    # The mean of what the camera sees in other episodes, the same picture all the time.
    "mean": Kind(
        "mean", "sends its mean", "sends its mean picture", "sent its mean picture", "MEAN"
    ),
    # Blended with uniform noise by ``strength``.
    "noise": Kind(
        "noise",
        "sends noise",
        "sends {strength} noise",
        "sent {strength} noise",
        "NOISE {strength}",
        _noisy,
        _STRENGTH,
    ),
    # The picture that arrived at the step before the first one it spoils. A click while step t is
    # shown spoils t, so t - 1 is held; a click while t + 1 is drawn spoils t + 1, so t is held.
    "freeze": Kind(
        "freeze",
        "is frozen",
        "is frozen",
        "was frozen",
        "FROZEN",
        lambda _, frame, before, rng: frame if before is None else before,
    ),
    # Gaussian, sigma = 8 px x ``strength``.
    "blur": Kind(
        "blur",
        "is blurred",
        "is blurred by {strength}",
        "was blurred by {strength}",
        "BLUR {strength}",
        _blurred,
        _STRENGTH,
    ),
    # A black rectangle, ``width`` and ``height`` as shares of the picture, whose middle is at
    # (``x``, ``y``), blended by ``strength``.
    "patch": Kind(
        "patch",
        "has a patch",
        "has a patch in view",
        "had a patch in view",
        "PATCH {strength}",
        _patched,
        ("strength", *PLACE),
    ),
    # A picture is lost with probability ``strength``, and the last one that came stays.
    "dropout": Kind(
        "lossy",
        "loses pictures",
        "loses {strength} of its pictures",
        "lost {strength} of its pictures",
        "LOSSY {strength}",
        _lost,
        _STRENGTH,
    ),
    # Every picture comes late, by ``strength`` x ``LATEST`` decisions.
    "delay": Kind(
        "late",
        "is late",
        "sends what it saw {late} steps ago",
        "was {late} steps late",
        "LATE BY {late}",
        uses=_STRENGTH,
    ),
    # Brighter or darker colours: times ``BRIGHTEST`` x ``strength``.
    "light": Kind(
        "light",
        "is lit",
        "sends a picture {light} times as bright",
        "sent a picture {light} times as bright",
        "LIGHT x{light}",
        _lit,
        _STRENGTH,
    ),
}
"""By ``OcclusionKind``, in the order in which page and notebooks offer them."""


def by_sides(values: dict[str, T]) -> dict[str, T]:
    """Fields of an occlusion, where ``size`` stands for ``width`` and ``height`` of a square: what
    patches were at first, and a short way to say it. Raises UserError for a size beside a side."""
    if "size" not in values:
        return values
    if "width" in values or "height" in values:
        raise UserError("a patch has a size or a width and a height, found both; drop the size")
    others = {name: value for name, value in values.items() if name != "size"}
    return {**others, "width": values["size"], "height": values["size"]}


@dataclass(frozen=True)
class CameraState:
    """One camera's switch and its occlusion."""

    input: CameraInput = "both"
    """Which modalities count; a policy takes those of them that it knows. ``off`` is dropped."""
    occlusion: Occlusion = Occlusion()

    def __post_init__(self) -> None:
        if self.input not in get_args(CameraInput):
            raise unknown("camera input", str(self.input), list(get_args(CameraInput)))


INTACT = CameraState()
"""The state of a camera that nobody has touched."""


@dataclass(frozen=True)
class Ablation:
    """The state of all cameras; cameras that are not named are intact."""

    cameras: dict[str, CameraState] = field(default_factory=dict)
    moves: dict[str, Displacement] = field(default_factory=dict)
    """The cameras that do not stand where they were trained."""

    def camera(self, name: str) -> CameraState:
        return self.cameras.get(name, INTACT)

    def replace(self, name: str, state: CameraState) -> Ablation:
        """The same ablation with another state of the camera ``name``."""
        return Ablation({**self.cameras, name: state}, self.moves)

    def move(self, name: str, to: Displacement | None) -> Ablation:
        """The same ablation with the camera ``name`` elsewhere; None: where it was trained."""
        others = {camera: move for camera, move in self.moves.items() if camera != name}
        return Ablation(self.cameras, others if to is None or to.is_none else {**others, name: to})

    def of(self, names: Sequence[str]) -> Ablation:
        """The same ablation of the cameras ``names`` alone."""
        return Ablation(
            {name: state for name, state in self.cameras.items() if name in names},
            {name: move for name, move in self.moves.items() if name in names},
        )

    def mask(self, streams: tuple[str, ...]) -> Array:
        """(V,) bool: the streams that are present."""
        switches = [self.camera(camera_of(stream)).input for stream in streams]
        return np.array(
            [
                switch == "both" or switch == modality_of(stream)
                for switch, stream in zip(switches, streams, strict=True)
            ],
            bool,
        )

    def present(self, streams: tuple[str, ...]) -> set[str]:
        """The cameras of which a policy with ``streams`` gets anything: one that gives nothing but
        depth to a policy of colour is as good as dropped."""
        pairs = zip(streams, self.mask(streams), strict=True)
        return {camera_of(stream) for stream, on in pairs if on}

    def occlusions(self) -> dict[str, Occlusion]:
        """The cameras that are occluded at all, and what is done to each."""
        return {
            name: state.occlusion.effective
            for name, state in self.cameras.items()
            if state.occlusion.kind != "none"
        }


def noise_generator(seed: int, step: int, stream: str) -> np.random.Generator:
    """The generator of a stream's noise at one step of one episode."""
    return np.random.default_rng([seed, step, zlib.crc32(stream.encode())])
