"""The input of a policy at the newest step, and what it would do with every subset of it.

    views ──► stack ──► encode ──► features (V, Z) ──► guard ──► probe
              last frames,                                       action and Q of every subset
              as they arrived

All of it changes together, so all of it is kept and put back together (``InputState``): a camera
command that fails leaves the policy with the pictures, features and actions that it had.
"""

from __future__ import annotations

import numpy as np

from madviz.analysis.probes import Probe, probe, read_row
from madviz.guard.policy import GuardedPolicy, GuardReport
from madviz.measure.mean_picture import stack_of
from madviz.observation.ablation import Ablation
from madviz.session.playing import Playing
from madviz.session.snapshot import InputState, StepData
from madviz.session.waiting import PolicyWait
from madviz.subsets import every_mask, row_of
from madviz.types import Array, Encoded, EnvSpec, Policy


class PolicyInput:
    """See the module. Another policy gets an input of its own."""

    probe: Probe
    encoded: Encoded
    used: Encoded
    """The features that the policy acts on: ``encoded``, unless a guard puts in others."""

    def __init__(self, policy: Policy, env: EnvSpec, wait: PolicyWait) -> None:
        """``wait`` knows when the policy is asked."""
        self._policy = policy
        self._wait = wait
        self.playing = Playing(wait)
        """Decides, and has the guard."""
        self._masks = every_mask(len(policy.spec.streams))  # (N, V)
        self.stack = stack_of(policy.spec, env)
        self.guard: GuardReport | None = None
        """On this step, where the policy has a guard."""
        self.unread = False
        """True where the policy gave no answer on the newest pictures: ``probe`` is older."""

    def begin(self, seed: int) -> None:
        """From now on the policy acts in the episode of ``seed``, and remembers nothing."""
        self.playing.begin(self._policy, seed)

    def push(self, data: StepData, ablation: Ablation, seed: int) -> None:
        """Takes the pictures of one step, with their occlusions; ``read`` is due then."""
        self.stack.push(data.views, ablation, seed, data.step)
        self.unread = True

    def read(self, state: Array, mask: Array) -> None:
        """Asks the policy: the pictures are encoded, with the robot's ``state``, and what it would
        do on ``mask`` (V,) and, where they cost no more, on all other subsets."""
        with self._wait:
            self.encoded = self._policy.encode(self.stack.views, state)  # features (V, Z)
        self.judge(mask)

    def judge(self, mask: Array) -> None:
        """Lets the guard judge the streams of ``mask`` (V,), and reads the subsets in the features
        that the policy would act on."""
        self.unread = True
        with self._wait:
            self.guard, self.used = self.playing.look(self.encoded, mask)
            only = None if self._policy.spec.reads_together else row_of(self.acts_on(mask))
            self.probe = probe(self._policy, self.used, self._masks, only)  # actions (N, A)
        self.unread = False

    @property
    def views(self) -> Array:
        """(V, C, H, W) uint8: the pictures that the policy acts on."""
        guarded = self._policy if isinstance(self._policy, GuardedPolicy) else None
        return self.stack.views if guarded is None else guarded.pictures(self.used)

    def acts_on(self, mask: Array) -> Array:
        """(V,) bool: the streams of ``mask`` (V,), but those that a guard leaves out."""
        return mask if self.guard is None else self.guard.mask

    def action(self, mask: Array) -> tuple[Array, float]:
        """The action (A,) and Q on ``mask`` (V,), read now if they are not."""
        row = row_of(self.acts_on(mask))
        self._read_row(row)
        return self.probe.readout.action[row], float(self.probe.readout.q[row])

    def read_more(self) -> bool:
        """Reads one more subset, where each costs a pass; whether there was one."""
        waiting = np.flatnonzero(self.probe.waiting)
        if len(waiting):
            self._read_row(int(waiting[0]))
        return bool(len(waiting))

    def state(self) -> InputState:
        """All of it, for ``restore``; pictures are shared."""
        return InputState(
            stack=self.stack.snapshot(),
            encoded=self.encoded,
            used=self.used,
            guard=self.guard,
            probe=self.probe,
            unread=self.unread,
        )

    def restore(self, saved: InputState) -> None:
        """Puts back what ``state`` gave."""
        self.stack.restore(saved.stack)
        self.encoded = saved.encoded
        self.used = saved.used
        self.guard = saved.guard
        self.probe = saved.probe
        self.unread = saved.unread

    def look_again(self, mask: Array) -> None:
        """The guard's report on ``mask`` (V,), from a player that has played up to here again."""
        self.guard, self.used = self.playing.look(self.encoded, mask)

    def _read_row(self, row: int) -> None:
        with self._wait:
            self.probe = read_row(self.probe, self._policy, self.used, row)
