"""Who acts in a simulation's episode, and what they looked at: so that they can do it again.

A policy with a memory decides from its looks so far, and nobody can set that memory back. But the
same looks give the same decisions. So a step is gone back to by playing the episode again up to it,
without simulator or pictures: with looks 0..39 kept, step 40 is there after 40 calls of ``act``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from madviz.guard.policy import GuardedPlayer, GuardReport
from madviz.policies.players import player_of
from madviz.session.waiting import PolicyWait
from madviz.types import Array, Encoded, Player, Policy, PolicyWithMemory

Look = tuple[Encoded, Array]
"""The input of a decision: the step, encoded, and the subset (V,)."""


class Playing:
    """The player of the present episode; nobody before ``begin``."""

    def __init__(self, wait: PolicyWait) -> None:
        """``wait`` knows when the player is asked."""
        self._wait = wait
        self._player: Player | None = None
        self.looks: list[Look] = []
        """The inputs of all decisions of a policy with a memory, since it began to act."""

    @property
    def planned(self) -> int:
        """Decisions that no camera can change any more."""
        return 0 if self._player is None else self._player.planned

    def begin(self, policy: Policy, seed: int) -> None:
        """From now on ``policy`` acts, and remembers nothing."""
        self.close()
        if isinstance(policy, PolicyWithMemory):
            with self._wait:
                self._player = player_of(policy, seed)

    def decide(self, encoded: Encoded, mask: Array, shown: Array) -> Array:
        """The action (A,) that is taken; without a memory it is ``shown``, the one on the page."""
        if self._player is None:
            return shown
        with self._wait:
            action = self._player.act(encoded, mask)
        self.looks.append((encoded, mask))
        return action

    def look(self, encoded: Encoded, mask: Array) -> tuple[GuardReport | None, Encoded]:
        """The report of a guard on this step, and the features that it would act on; without a
        guard, None and ``encoded``."""
        if isinstance(self._player, GuardedPlayer):
            return self._player.look(encoded, mask)
        return None, encoded

    def again(
        self, policy: Policy, seed: int, looks: Sequence[Look], actions: Sequence[Array]
    ) -> bool:
        """Plays the episode ``seed`` again as far as ``looks``; whether ``policy`` decided the same
        as the last of ``actions``, so that it stands where it stood."""
        self.begin(policy, seed)
        taken = actions[len(actions) - len(looks) :]
        return all(
            np.array_equal(self.decide(*look, action), action)
            for look, action in zip(looks, taken, strict=True)
        )

    def close(self) -> None:
        """Nobody plays any more."""
        if self._player is not None:
            self._player.close()
        self._player = None
        self.looks = []
