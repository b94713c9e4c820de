"""The words every other file speaks: observations, cameras, policies. NumPy and shapes alone.

Axis letters, used in every shape of the package:

    B  batch            V  streams (a camera in one modality)     N  subsets of streams
    C  channels         H, W  image rows, columns                 S  proprioceptive state
    Z  feature          A  action

A *camera* is a place to look from. A *stream* is one camera in one modality, as the policy gets it:
``first.rgb``, ``first.depth``; where a policy has one modality, the camera's name is the stream's.
A *subset* is the set of streams that is present; it reaches a policy as a boolean mask over V, so
that dropping a camera is data and never a code path.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from madviz.errors import UserError, unknown
from madviz.state_numbers import StateNumbers

Array = np.ndarray
Modality = Literal["rgb", "depth"]


@dataclass(frozen=True)
class CameraSpec:
    """A place to look from, and how its depth is coded for a policy."""

    name: str
    label: str
    """The page's name for it, for example ``Third A``."""
    fovy: float
    """Vertical field of view, degrees."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Metres; in the world, or relative to ``body`` if one is named (ManiSkill: in its frame)."""
    wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation in the world, OpenGL camera axes: x right, y up, looking along -z. A ManiSkill
    camera on a body turns with it, and this is in the body's frame."""
    body: str | None = None
    """The body whose position the camera follows; in Meta-World it does not turn with it."""
    depth_range: tuple[float, float] = (0.0, 2.0)
    """Metres that map to 0 and 255 when depth is handed to a policy."""
    size: int = 84
    """Rows and columns the camera is drawn with."""


@dataclass(frozen=True)
class CameraPose:
    """Where a camera really is now, for drawing its frustum."""

    position: Array
    """(3,) metres, world frame."""
    wxyz: Array
    """(4,) OpenCV camera axes: x right, y down, looking along +z; world frame."""
    fovy: float
    """Vertical field of view, degrees."""


@dataclass(frozen=True)
class EnvSpec:
    """The facts of an environment that a policy, a card and a page need."""

    task: str
    cameras: tuple[CameraSpec, ...]
    state_dim: int
    action_dim: int
    horizon: int
    """Decisions in one episode; only tasks of LeRobot end earlier, with a success."""
    action_repeat: int = 1
    """Simulator steps for one decision."""
    render_profile: str = "fast"
    state_numbers: StateNumbers = StateNumbers()
    """The numbers of the state by what they say."""
    gripper: Literal["", "closes at 1", "closes at -1"] = ""
    """The effect of the last number of an action on the gripper; '' where it has none."""
    success: str = "at the last step"
    """The task's own success condition, in words."""
    instruction: str = ""
    """The task in words, for a policy that takes language."""
    action_spread: tuple[float, ...] = ()
    """Standard deviation of each number of the recorded actions; only recordings have it."""

    @property
    def recorded(self) -> bool:
        """True where its episodes were recorded, so that actions change nothing."""
        return bool(self.action_spread)

    def camera(self, name: str) -> CameraSpec:
        """The camera called ``name``. Raises UserError naming the known ones."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise unknown("camera", name, [camera.name for camera in self.cameras])


@dataclass(frozen=True)
class TimeStep:
    """The result of one decision; pixels are asked for separately with ``Environment.view``."""

    state: Float[Array, " S"]
    """Proprioception."""
    reward: float
    success: bool
    """The task's condition at this very step."""
    last: bool
    """True at the end of the horizon."""


@dataclass(frozen=True)
class View:
    """The pictures of one camera now."""

    rgb: UInt8[Array, "H W 3"]
    """Upright, not mirrored."""
    depth: Float[Array, "H W"]
    """Metres along the optical axis."""


@dataclass(frozen=True, eq=False)
class Part:
    """A piece of a body, of one colour."""

    vertices: Array
    """(n, 3) float32 metres, in the frame of its body."""
    faces: Array
    """(m, 3) int32 into ``vertices``, counter-clockwise seen from outside."""
    colour: Array
    """(3,) uint8."""


@dataclass(frozen=True, eq=False)
class Body:
    """Something that moves as one, as it looks: a link, an object, the table."""

    name: str
    """Unique in its scene."""
    parts: tuple[Part, ...]


class Environment(Protocol):
    """A seeded task: an episode depends on its seed, never on earlier ones or other processes.

    An instance belongs to the thread that created it, because OpenGL contexts do.
    """

    spec: EnvSpec

    def reset(self, seed: int) -> TimeStep:
        """Begins the episode of ``seed``."""
        ...

    def step(self, action: Array) -> TimeStep:
        """One decision. ``action`` is (A,) in [-1, 1]. Raises UserError if it is not finite."""
        ...

    def view(self, camera: str, size: int | None = None) -> View:
        """Draws one camera now; ``size`` in pixels overrides the camera's own."""
        ...

    def pose(self, camera: str) -> CameraPose:
        """Where one camera is now. Raises UserError for an unknown one."""
        ...

    def move_camera(self, camera: str, to: CameraSpec | None) -> None:
        """From now on, over resets too, ``camera`` stands, looks and zooms as ``to`` says (its
        position, wxyz, body and fovy; nothing else of it counts); None puts it back where ``spec``
        has it. ``view`` and ``pose`` follow, ``spec`` stays. Raises UserError for an unknown
        camera or body and for numbers that are no place."""
        ...

    def bodies(self) -> tuple[Body, ...]:
        """The bodies of the present episode, as they look: the same object until that changes."""
        ...

    def body_poses(self) -> Array:
        """(N, 7) float32: position in metres and wxyz in the world, in the order of ``bodies``."""
        ...

    def hand(self) -> Array:
        """(3,) float32 metres, world frame: the middle between the gripper's fingertips."""
        ...

    def expert(self) -> Array:
        """(A,) what the scripted expert would do now. It may look at the simulator's true state."""
        ...

    def close(self) -> None:
        """Frees what the simulator and the renderer hold."""
        ...


@runtime_checkable
class ResetsInPieces(Protocol):
    """An environment whose reset takes long enough to be felt on a page."""

    def reset_in_pieces(self, seed: int, between: Callable[[], None]) -> TimeStep:
        """``reset``, to the bit, with ``between`` called every few milliseconds. It must not touch
        the environment."""
        ...


@runtime_checkable
class KnowsPlaces(Protocol):
    """An environment that also tells where what matters is. For training and measuring alone: no
    policy gets it."""

    def places(self) -> Array:
        """(3 P,) float32 metres, world frame: x, y, z of the task's objects and of its goal now, in
        a fixed order. A property ``place_names``, (P,) texts, may say what they are."""
        ...


@dataclass(frozen=True)
class Encoded:
    """The features of all streams at one time step, before a subset is chosen."""

    features: Float[Array, "V Z"]
    """One row per stream."""
    state: Float[Array, " S"]
    private: Any = None
    """Whatever else this policy needs in ``read``; nobody else looks inside."""


@dataclass(frozen=True)
class Readout:
    """The decisions of a policy under each of N subsets."""

    merged: Float[Array, "N Z"]
    """The merged feature."""
    action: Float[Array, "N A"]
    """In [-1, 1], the deterministic action."""
    q: Float[Array, " N"]
    """Min of the two critics for that action; NaN where a policy has no critic."""


@dataclass(frozen=True)
class PolicySpec:
    """The facts about a policy that a page or an evaluator needs. Comes from its checkpoint's
    config."""

    name: str
    task: str
    method: str
    setting: str
    recipe: str
    streams: tuple[str, ...]
    """Names in the order of axis V."""
    trained_subsets: tuple[str, ...]
    """Subsets it was trained to work from; it was not trained on any other."""
    frame_stack: int = 3
    render_profile: str = "fast"
    cameras: tuple[CameraSpec, ...] = ()
    """Its streams' cameras as they stood in training, for ``make_env``; empty: the suite's own."""
    digest: str = ""
    """SHA-256 of weights and config; the key under which results are cached."""
    state_dim: int = 0
    """S, A and decisions in an episode of the environment it was trained in; 0: it does not say."""
    action_dim: int = 0
    horizon: int = 0
    image_size: int = 84
    """H and W of ``views``; a camera that is drawn at another size (``cameras``) is resized."""
    instruction: str = ""
    """The task in words, for a policy that takes language."""
    chunk: int = 1
    """Decisions it may take from one look; a camera that fails meanwhile counts at the next."""
    can_drop: bool = True
    """Whether a camera can be left out. If not, each needs a picture: black, the mean, noise."""
    reads_together: bool = True
    """Whether many subsets are read in one pass; False: each costs a pass, and a page reads those
    that are asked for."""

    def __post_init__(self) -> None:
        """Raises UserError for streams that are none: others would be read as colour."""
        names = self.streams
        stream = rf"[^.]+(\.({'|'.join(get_args(Modality))}))?"
        sound = isinstance(names, tuple) and all(re.fullmatch(stream, str(n)) for n in names)
        if not sound or not names or len(set(names)) < len(names):
            raise UserError(
                f"{self.name}: expected streams as a tuple of cameras, each once, such as "
                f"('first', 'third_a.depth'), found {names!r:.100}"
            )
        if (least := min(self.frame_stack, self.image_size)) < 1:
            raise UserError(f"{self.name}: expected 1 frame and pixel or more, found {least}")


@runtime_checkable
class Policy(Protocol):
    """Three small methods; anything that has them can be explored and evaluated."""

    spec: PolicySpec

    def encode(self, views: Array, state: Array) -> Encoded:
        """``views`` (V, C, H, W) uint8 with C = 3 x frame stack; ``state`` (S,) float32."""
        ...

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        """``masks`` (N, V) bool, the subsets to read, in one pass through the heads."""
        ...

    def supports(self, mask: Array) -> bool:
        """Whether this policy can act at all on the subset ``mask`` (V,)."""
        ...


@runtime_checkable
class TakesPictures(Policy, Protocol):
    """A policy whose streams have pictures of their own heights and widths. It is served with
    them; its ``views`` cannot hold them."""

    shapes: dict[str, tuple[int, int]]
    """Rows and columns by stream."""

    def encode_pictures(self, pictures: dict[str, Array], state: Array) -> Encoded:
        """``encode`` of pictures (H, W, 3) uint8 by stream, each in its own shape; a stream that is
        not there was not sent."""
        ...


@runtime_checkable
class Imagines(Policy, Protocol):
    """A policy that can draw what a missing camera would see, if ``imagines``."""

    @property
    def imagines(self) -> bool: ...

    def imagine(self, encoded: Encoded, mask: Array) -> Array:
        """(V, H, W, 3) uint8: every stream's newest frame, drawn from those in ``mask`` alone."""
        ...

    def mean_pictures(self) -> Array:
        """(V, H, W, 3) uint8: what a stream showed on average in training."""
        ...


@dataclass(frozen=True)
class Future:
    """A policy's imagination of T decisions to come."""

    pictures: Array
    """(T, V, H, W, 3) uint8: what every stream would show after each decision."""
    reward: Array
    """(T,) float32, for each decision."""
    action: Array
    """(T, A) float32: what would be decided."""


@runtime_checkable
class Foresees(Policy, Protocol):
    """A policy that can go on without pictures, in a world model of its own, if ``foresees``."""

    @property
    def foresees(self) -> bool: ...

    def foresee(self, encoded: Encoded, mask: Array, decisions: int) -> Future:
        """The likeliest course of the next ``decisions``, begun from the streams in ``mask``."""
        ...


@runtime_checkable
class Player(Protocol):
    """Who acts in one episode. What a policy remembers of an episode is kept here, so that two
    episodes that run at the same time do not mix."""

    planned: int
    """Decisions that are settled already, whatever the cameras send."""

    def act(self, encoded: Encoded, mask: Array) -> Array:
        """The next decision (A,), on the subset ``mask`` (V,); called once for each, in order."""
        ...

    def close(self) -> None:
        """The episode is over, or was left."""
        ...


@runtime_checkable
class PolicyWithMemory(Policy, Protocol):
    """A policy that acts from earlier steps of an episode, too: it has a history, or takes several
    decisions from one look. ``read`` says what it would do if it looked anew, and changes nothing.
    """

    def reset(self, seed: int) -> Player:
        """An episode begins. ``seed`` fixes the policy's own noise, so that two subsets differ by
        their cameras alone: the same seed and the same looks give the same decisions."""
        ...
