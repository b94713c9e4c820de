"""Who acts in an episode: a policy without a memory, or the player that one with a memory gives.

player = player_of(policy, seed)
while not now.last:
    now = env.step(player.act(policy.encode(stack.views, now.state), mask))
player.close()
"""

from __future__ import annotations

from madviz.types import Array, Encoded, Player, Policy, PolicyWithMemory


class Reader:
    """Acts with a policy that needs nothing but the present step."""

    planned = 0

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._outside_before = getattr(policy, "outside", 0)

    @property
    def outside(self) -> int:
        """Action numbers of this episode that the policy itself clipped to [-1, 1]."""
        return getattr(self._policy, "outside", 0) - self._outside_before

    def act(self, encoded: Encoded, mask: Array) -> Array:
        """(A,): the subset ``mask`` (V,) read alone."""
        return self._policy.read(encoded, mask[None]).action[0]

    def close(self) -> None:
        """There is nothing to free."""


def player_of(policy: Policy, seed: int) -> Player:
    """Who plays the episode ``seed`` for ``policy``."""
    return policy.reset(seed) if isinstance(policy, PolicyWithMemory) else Reader(policy)
