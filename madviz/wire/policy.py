"""A served policy behind the ``Policy`` protocol.

``encode`` keeps the pictures, ``read`` sends those of a subset and takes the first action of the
answer: a pass for each subset. Such questions go over a connection of their own, each as the first
of an episode, because many servers remember the rest of a chunk for whoever is connected; whoever
acts in an episode has another connection, and its answers in order (``ServedPlayer``).

Where its task is a recording, states and actions go over the wire in the robot's own units, and
the words are those of the episode at hand, unless the wire file has its own.

A camera that is left out is not sent. Where the server cannot do without (``masks = false``), only
the whole set is supported, and a failing camera must send something.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from madviz.errors import UserError
from madviz.recorded.films import between_bars
from madviz.recorded.known import is_recording, recordings_of
from madviz.recorded.robot import robot_of
from madviz.subsets import camera_of, modality_of, name_of
from madviz.system.address import ServerAddress
from madviz.types import Array, Encoded, PolicySpec, Readout
from madviz.wire.connection import PolicyConnection
from madviz.wire.protocols import BOXED, Speaker, greeted, identity_in, look
from madviz.wire.wiring import Wiring, env_of


@dataclass(frozen=True)
class ServedLook:
    """The input of a server at one step."""

    pictures: dict[str, Array]
    """(H, W, C) by stream, as it is sent."""
    answers: dict[bytes, Array] = field(default_factory=dict)
    """By subset what was answered, (n, A)."""


class ServedPolicy:
    """See the module. It may be used by several threads."""

    def __init__(
        self,
        address: ServerAddress,
        wiring: Wiring,
        spec: PolicySpec,
        supported: frozenset[str] | None,
        identity: dict[str, str],
        said: bool = False,
    ) -> None:
        """``supported``: the subsets it can act on, by name; None: those that ``wiring`` says. The
        ``protocol`` of ``wiring`` must be known. ``identity``: what the server said that it serves
        (``identity_in``). ``said``: whether the server said ``wiring`` itself, as madviz's do, and
        no file did. Nothing is connected yet."""
        self.spec = spec
        self.address = address
        self.wiring = wiring
        self.identity = identity
        self._supported = supported
        self._said = said
        self._env = env_of(wiring)
        self._robot = robot_of(recordings_of(spec.task)) if is_recording(spec.task) else None
        self._connection = PolicyConnection(address, wiring.timeout)
        self._speaker: Speaker | None = None
        self._lock = threading.Lock()
        self._warm = False

    @property
    def stateless(self) -> bool:
        """Whether an answer depends on the look alone, whoever asks and whatever was asked."""
        return not self.wiring.history and (self._said or self.wiring.protocol == "openpi")

    @property
    def has_digest(self) -> bool:
        """Whether the server says a digest of its weights."""
        return bool(self.identity.get("digest"))

    def encode(self, views: Array, state: Array) -> Encoded:
        """(V, C, H, W) to pictures, each in its own size. There are no features."""
        pictures = {}
        for stream, view in zip(self.spec.streams, views, strict=True):
            picture = np.ascontiguousarray(view.transpose(1, 2, 0))  # (S, S, C)
            shape = self.wiring.shape_of(stream)
            if self._robot is not None and shape[0] != shape[1]:
                camera = self._robot.camera(camera_of(stream))
                picture = picture[between_bars(camera.height, camera.width, len(picture))]
            picture = _sized(picture, shape, self.wiring.stretch)
            colour = modality_of(stream) != "depth"
            pictures[stream] = self.wiring.sent_picture(picture, camera_of(stream), colour)
        state = np.asanyarray(state, np.float32)  # What was recorded stays with it.
        return Encoded(np.zeros((len(views), 1), np.float32), state, ServedLook(pictures))

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        """The actions of a policy whose episode begins with this look; a pass for each of
        ``masks``."""
        masks = np.atleast_2d(masks)
        answers = [self.first_answer(encoded, mask) for mask in masks]
        actions = np.stack([self.own_action(answer, encoded.state) for answer in answers])  # (N, A)
        unknown = np.full(len(masks), np.nan, np.float32)
        return Readout(np.zeros((len(masks), 1), np.float32), np.clip(actions, -1, 1), unknown)

    def first_answer(self, encoded: Encoded, mask: Array) -> Array:
        """(A,) float32 as it comes, of a policy whose episode begins with this look."""
        with self._lock:
            return self._asked(encoded, mask)[0]

    def supports(self, mask: Array) -> bool:
        if len(mask) != len(self.spec.streams):
            return False
        if self._supported is not None:
            return name_of(mask, self.spec.streams) in self._supported
        return bool(self.wiring.masks or np.all(mask))

    def reset(self, seed: int) -> ServedPlayer:
        """Connects, and begins an episode."""
        return ServedPlayer(self, seed)

    def close(self) -> None:
        """Hangs up, until it is asked again."""
        with self._lock:
            self._connection.close()

    def own_action(self, answer: Array, state: Array) -> Array:
        """A row (A,) of an answer as the task's action (A,), before it is clipped; ``state`` (S,)
        is the one it acts in, as ``encode`` took it."""
        action = self.wiring.own_action(answer, self._raw(state), self._env)
        return self._robot.actions.scale(action) if self._robot else action

    def begun(self, connection: PolicyConnection, seed: int) -> Speaker:
        """Connects ``connection`` and begins an episode on it. Raises UserError where another
        policy is served there by now."""
        speaker, greeting = greeted(connection, self.wiring.protocol)
        identity = identity_in(greeting)
        if identity != self.identity:
            raise connection.wrong(
                f"the policy that says {self.identity!s:.150}",
                f"{identity!s:.150}",
                "another one is served there by now: start again",
            )
        speaker.begin(connection, seed, self.spec.task)
        return speaker

    def answer(
        self,
        connection: PolicyConnection,
        speaker: Speaker,
        encoded: Encoded,
        mask: Array,
        noise: int,
    ) -> Array:
        """(n, A) float32, n >= 1, what is answered on ``connection``, as it comes. Raises UserError
        for an answer that is none."""
        shown_now = {
            stream: picture
            for (stream, picture), on in zip(encoded.private.pictures.items(), mask, strict=True)
            if on
        }
        words = getattr(encoded.state, "task", None)  # A ``RecordedState`` has them.
        if words is None or self.wiring.instruction is not None:
            words = self.spec.instruction
        state = self.wiring.sent_state(self._raw(encoded.state), self._env)
        message = look(self.wiring, speaker.name, shown_now, state, words, noise)
        if self._said and self._robot is not None:
            message[BOXED] = True
        connection.answered |= self._warm
        found = speaker.ask(connection, message)
        self._warm = True
        return self._checked(connection, found)

    def _raw(self, state: Array) -> Array:
        """``state`` (S,) in the robot's units: as it was recorded, where that is known."""
        if self._robot is None:
            return state
        recorded = getattr(state, "raw", None)
        return self._robot.states.unscale(state) if recorded is None else recorded

    def _asked(self, encoded: Encoded, mask: Array) -> Array:
        if not self.supports(mask):
            raise UserError(
                f"{self.spec.name} cannot act on {name_of(mask, self.spec.streams)!r}; "
                "bring the missing cameras back"
            )
        answers = encoded.private.answers
        if mask.tobytes() not in answers:
            if self._speaker is None or not self._connection.is_open:
                self._speaker = self.begun(self._connection, 0)
            elif not self.stateless:
                self._speaker.begin(self._connection, 0, self.spec.task)
            answers[mask.tobytes()] = self.answer(self._connection, self._speaker, encoded, mask, 0)
        return answers[mask.tobytes()]

    def _checked(self, connection: PolicyConnection, found: dict[str, Any]) -> Array:
        key = self.wiring.action
        count = self.spec.action_dim
        expected = f"{key!r} of {count} finite numbers, or rows of them"
        if key not in found:
            named = ", ".join(sorted(map(str, found)))
            raise connection.wrong(expected, f"an answer with {named or 'nothing'!s:.100}")
        try:
            action = np.atleast_2d(np.asarray(found[key], np.float32))
        except (TypeError, ValueError) as error:
            raise connection.wrong(expected, "something that is no number") from error
        if action.ndim != 2 or action.shape[1] != count or not len(action):
            raise connection.wrong(expected, f"the shape {np.shape(found[key])}")
        if not np.isfinite(action).all():
            raise connection.wrong(expected, "NaN or infinity")
        return action


class ServedPlayer:
    """Acts in one episode, over its own connection; takes ``chunk`` decisions of every answer."""

    def __init__(self, policy: ServedPolicy, seed: int) -> None:
        self._policy = policy
        self._seed = seed
        self._step = 0
        self.outside = 0
        """Numbers of the actions so far that lay outside [-1, 1]; they are clipped."""
        self._connection = PolicyConnection(policy.address, policy.wiring.timeout)
        self._plan: list[Array] = []
        self._speaker: Speaker | None = (
            None if policy.stateless else policy.begun(self._connection, seed)
        )

    @property
    def planned(self) -> int:
        return len(self._plan)

    def act(self, encoded: Encoded, mask: Array) -> Array:
        """(A,). Raises UserError where the server does not answer as expected. If it does not
        remember the episode, it may be asked again."""
        if not self._plan:
            answer = self._answer(encoded, mask)
            self._plan = list(answer[: self._policy.wiring.chunk])
        self._step += 1
        action = self._policy.own_action(self._plan.pop(0), encoded.state)
        self.outside += numbers_outside(action)
        return np.clip(action, -1, 1)

    def close(self) -> None:
        self._connection.close()

    def _answer(self, encoded: Encoded, mask: Array) -> Array:
        policy = self._policy
        same = policy.stateless and not policy.wiring.noise  # Answers to ``read`` had noise 0.
        known = encoded.private.answers.get(mask.tobytes()) if same else None
        if known is not None:
            return known
        if self._speaker is None or not self._connection.is_open:
            if self._step and policy.wiring.history:
                raise UserError(
                    f"{policy.address}: expected the connection of this episode, found it "
                    "closed, and what the policy remembered is lost; start the episode again"
                )
            self._speaker = policy.begun(self._connection, self._seed)
        noise = noise_at(self._seed, self._step)
        return policy.answer(self._connection, self._speaker, encoded, mask, noise)


def numbers_outside(action: Array) -> int:
    """Numbers of ``action`` (A,) that lie outside [-1, 1] by more than rounding."""
    return int(np.count_nonzero(np.abs(action) > 1 + 1e-6))


def noise_at(seed: int, step: int) -> int:
    """The number that fixes a policy's noise at one step of an episode: the same for every subset,
    so that they differ by their cameras alone."""
    return int(np.random.SeedSequence([seed, step]).generate_state(1)[0] >> 1)


def _sized(picture: Array, shape: tuple[int, int], stretch: bool) -> Array:
    """(h, w, C) -> (H, W, C), ``shape`` being H and W: the largest of its aspect that fits, and
    equal black bars beside it; or, with ``stretch``, all of ``shape``."""
    height, width = picture.shape[:2]
    scale = min(shape[0] / height, shape[1] / width)
    target = shape if stretch else (round(height * scale), round(width * scale))
    if picture.shape[:2] != target:
        frames = [picture[..., i : i + 3] for i in range(0, picture.shape[-1], 3)]
        sized = [cv2.resize(frame, target[::-1], interpolation=cv2.INTER_AREA) for frame in frames]
        picture = np.concatenate(sized, axis=-1)
    if shape == target:
        return picture
    boxed = np.zeros((*shape, picture.shape[-1]), np.uint8)  # (H, W, C)
    top = (shape[0] - target[0]) // 2
    left = (shape[1] - target[1]) // 2
    boxed[top : top + target[0], left : left + target[1]] = picture
    return boxed
