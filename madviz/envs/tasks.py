"""The tasks, and when each is a success in the pinned version of its simulator, in words for cards
and pages."""

from __future__ import annotations

METAWORLD_SUCCESS = {
    "basketball": "the ball is within 0.08 m of the hoop's goal",
    "hammer": "the nail is driven in by more than 0.09 m",
    "peg-insert-side": "the peg's head is within 0.07 m of the end of the hole",
    "soccer": "the ball is within 0.07 m of the goal",
    "sweep-into": "the cube is within 0.05 m of the goal in the hole",
    "assembly": "the wrench's ring is aligned with the peg and hooked over it",
    "hand-insert": "the cube is within 0.05 m of the goal in the hole",
    "pick-out-of-hole": "the puck is within 0.07 m of the goal",
    "pick-place": "the puck is within 0.07 m of the goal",
    "push": "the puck is within 0.05 m of the goal",
    "shelf-place": "the cube is within 0.07 m of the goal on the shelf",
    "disassemble": "the wrench is lifted above the peg",
    "stick-pull": "the thermos handle is within 0.12 m of the goal and the stick is through it",
    "stick-push": "the thermos is within 0.12 m of the goal and the stick is held",
    "pick-place-wall": "the puck is within 0.07 m of the goal behind the wall",
}
"""The paper's 15: five medium, five hard, five very hard."""

MANISKILL_SUCCESS = {
    "push-cube": "the cube's middle is within 0.1 m of the target's and the cube is on the table",
    "pull-cube": "the cube's middle is within 0.1 m of the target's, seen from above",
    "pick-cube": "the cube is within 0.025 m of the goal and no joint is faster than 0.2 rad/s",
    "place-sphere": "the sphere rests in the bin, at most 5 mm from its middle, and is let go",
    "poke-cube": "the cube is within 0.05 m of the target and no joint is faster than 0.2 rad/s",
}
