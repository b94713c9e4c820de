"""Which pixels a policy's Q, or its action, depends on. The only importer of captum.

The question is a derivative. Let s be one number that the policy makes of its pictures, Q or the
norm of its action; |ds/dx| says how much s moves when pixel x changes by one grey level. One
picture's derivative is grainy, because a network of ReLUs is piecewise linear and every pixel sits
near some crease. So it is averaged over a few copies with noise on them (SmoothGrad: Smilkov and
others, arXiv 1706.03825; the derivative itself: Simonyan and others, arXiv 1312.6034).

Worked: the derivative of all streams and ``COPIES`` noisy copies is one pass forward and one back
over COPIES x V pictures, 9 for three cameras. The frames of a stack and the three colours of a
pixel are one place on the page: the greatest of the nine counts. All streams share one scale, so
that a stream that matters little stays dark; a stream that is not present has derivative 0.

Derivatives need a network made with torch; a policy behind ``module:factory`` may be anything, and
then there is no map, and a page says so. Importing captum takes some seconds and a call some 50 ms,
so nothing here is loaded before somebody asks, and ``LiveSaliency`` asks rarely.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from importlib import import_module
from typing import Any, Literal, get_args

import numpy as np

from madviz.errors import UserError, unknown
from madviz.types import Array, Policy

Target = Literal["q", "action"]
COPIES = 3
NOISE = 16.0
"""Noisy copies that are averaged, and the standard deviation of their noise in grey levels."""
BRIGHT = 99.5
"""Percentile that becomes 1: a few pixels would otherwise make all others dark."""
PERIOD = 0.5
"""Seconds between two maps while an episode runs."""


def saliency(
    policy: Policy, views: Array, state: Array, mask: Array, target: Target = "q"
) -> Array | None:
    """(V, H, W) float32 in [0, 1]: how much ``target`` depends on each place of each stream.

    ``views`` (V, C, H, W) uint8, ``state`` (S,), ``mask`` (V,) bool. The same input has the same
    map. None for a policy without torch networks, and where it cannot act on ``mask``.
    Raises UserError for an unknown target.
    """
    if target not in get_args(Target):
        raise unknown("saliency target", target, list(get_args(Target)))
    agent = getattr(policy, "agent", None)
    if agent is None or not hasattr(agent, "encoder") or not policy.supports(mask):
        return None
    import torch
    from captum.attr import NoiseTunnel, Saliency

    pictures = torch.from_numpy(views)[None]
    number = _number(agent, pictures, state, mask, target)
    # The noise comes from torch's own generator, which others want to find as they left it.
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        torch.manual_seed(0)
        slopes: Any = NoiseTunnel(Saliency(number)).attribute(
            pictures.float(), nt_type="smoothgrad", nt_samples=COPIES, stdevs=NOISE
        )
    return _unit(slopes[0].detach().numpy().max(1))


def _number(
    agent: Any, pictures: Any, state: Array, mask: Array, target: Target
) -> Callable[[Any], Any]:
    """(B, V, C, H, W) floating pixels -> (B,): the policy's own way from pixels to ``target``."""
    import torch

    noise = agent.encoder.noise_to_act(pictures)
    present = torch.from_numpy(np.asarray(mask, bool))[None]
    known = torch.from_numpy(np.asarray(state, np.float32))

    def number(pixels: Any) -> Any:
        features = agent.encoder.encode_to_act(pixels)
        rows = agent.encoder.rows(features, present, noise)[0]
        states = known.expand(len(rows), -1)
        action = torch.tanh(agent.actor(rows, states)[0])
        if target == "action":
            return action.norm(dim=-1)
        return torch.minimum(*agent.critic(rows, states, action))

    return number


def _unit(slopes: Array) -> Array:
    """(V, H, W) of 0 and more -> [0, 1], one scale for all; all 0 stays 0."""
    top = float(np.percentile(slopes[slopes > 0], BRIGHT)) if (slopes > 0).any() else 1.0
    return np.clip(slopes / max(top, 1e-30), 0, 1).astype(np.float32)


class LiveSaliency:
    """The maps of a running session; belongs to the thread that owns its policy."""

    def __init__(self) -> None:
        self.target: Target | None = None
        self.maps: dict[str, Array] | None = None
        """(H, W) in [0, 1] by stream; None while there are none."""
        self._of: tuple[object, bytes]
        """The time step and the mask that the maps belong to."""
        self._done: float
        self._ready = self._loading = False
        self.forget()

    def ask(self, target: Target | None, wake: Callable[[], None]) -> None:
        """Sets what is explained from now on; None: nothing. The first time, captum is loaded in a
        thread of its own, so that an episode does not stop, and then ``wake`` is called from there:
        what is asked for by then may be due."""
        if target != self.target:
            self.target = target
            self.forget()
        if target is not None and not self._ready and not self._loading:
            self._loading = True

            def load() -> None:
                try:
                    import_module("captum.attr")
                    self._ready = True
                finally:
                    self._loading = False
                wake()

            threading.Thread(target=load, name="madviz-captum", daemon=True).start()

    def forget(self) -> None:
        """Another policy or episode: what is known is of no use, the next map is due at once."""
        self.maps = None
        self._of = (None, b"")
        self._done = -1e9

    def due(self, shown: object, mask: Array, now: float, moving: bool, full_speed: bool) -> bool:
        """Whether ``shown``, whatever object stands for what is shown, needs a new map now:
        at once while nothing moves, twice a second while it does, never at full speed."""
        if moving and full_speed:
            self.forget()
        elif self.target is not None and self._ready:
            known = shown is self._of[0] and np.asarray(mask, bool).tobytes() == self._of[1]
            return not known and (not moving or now - self._done >= PERIOD)
        return False

    def update(
        self,
        policy: Policy,
        views: Array,
        state: Array,
        mask: Array,
        shown: object,
        now: float,
    ) -> None:
        """Makes the maps of ``shown``; see ``saliency`` for the rest."""
        self._of = (shown, np.asarray(mask, bool).tobytes())
        self._done = now
        if self.target is None:
            raise UserError("expected a target, found none; ask for q or action first")
        maps = saliency(policy, views, state, mask, self.target)
        self.maps = None if maps is None else dict(zip(policy.spec.streams, maps, strict=True))
