"""The tasks: when each is a success in the pinned version of its simulator, in words for cards and
pages, and as instructions for a policy that takes language."""

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

INSTRUCTIONS = {
    "metaworld/basketball": "Put the ball through the hoop.",
    "metaworld/hammer": "Pick up the hammer and drive the nail in.",
    "metaworld/peg-insert-side": "Put the peg into the hole in the side of the box.",
    "metaworld/soccer": "Push the ball into the goal.",
    "metaworld/sweep-into": "Sweep the cube into the hole.",
    "metaworld/assembly": "Pick up the wrench and put its ring over the peg.",
    "metaworld/hand-insert": "Put the cube into the hole.",
    "metaworld/pick-out-of-hole": "Pick the puck out of the hole and bring it to the goal.",
    "metaworld/pick-place": "Pick up the puck and bring it to the goal.",
    "metaworld/push": "Push the puck to the goal.",
    "metaworld/shelf-place": "Pick up the cube and put it on the shelf.",
    "metaworld/disassemble": "Lift the wrench off the peg.",
    "metaworld/stick-pull": "Pull the thermos to the goal with the stick.",
    "metaworld/stick-push": "Push the thermos to the goal with the stick.",
    "metaworld/pick-place-wall": "Pick up the puck and bring it over the wall to the goal.",
    "maniskill/push-cube": "Push the cube to the target.",
    "maniskill/pull-cube": "Pull the cube to the target.",
    "maniskill/pick-cube": "Pick up the cube and bring it to the goal.",
    "maniskill/place-sphere": "Pick up the sphere and put it into the bin.",
    "maniskill/poke-cube": "Poke the cube to the target with the peg.",
    "toy/reach": "Go to the orange target.",
}
"""By task. The sentences are ours: neither the paper nor the simulators have any."""

DONE = {
    "metaworld/basketball": ("put the ball through the hoop", "put the ball through the hoop"),
    "metaworld/hammer": ("drive the nail in", "drove the nail in"),
    "metaworld/peg-insert-side": ("put the peg in", "put the peg in"),
    "metaworld/soccer": ("bring the ball into the goal", "brought the ball into the goal"),
    "metaworld/sweep-into": ("sweep the cube into the hole", "swept the cube into the hole"),
    "metaworld/assembly": ("put the ring over the peg", "put the ring over the peg"),
    "metaworld/hand-insert": ("put the cube into the hole", "put the cube into the hole"),
    "metaworld/pick-out-of-hole": ("bring the puck to the goal", "brought the puck to the goal"),
    "metaworld/pick-place": ("bring the puck to the goal", "brought the puck to the goal"),
    "metaworld/push": ("push the puck to the goal", "pushed the puck to the goal"),
    "metaworld/shelf-place": ("put the cube on the shelf", "put the cube on the shelf"),
    "metaworld/disassemble": ("lift the wrench off the peg", "lifted the wrench off the peg"),
    "metaworld/stick-pull": ("pull the thermos to the goal", "pulled the thermos to the goal"),
    "metaworld/stick-push": ("push the thermos to the goal", "pushed the thermos to the goal"),
    "metaworld/pick-place-wall": ("bring the puck to the goal", "brought the puck to the goal"),
    "maniskill/push-cube": ("push the cube to the target", "pushed the cube to the target"),
    "maniskill/pull-cube": ("pull the cube to the target", "pulled the cube to the target"),
    "maniskill/pick-cube": ("bring the cube to the goal", "brought the cube to the goal"),
    "maniskill/place-sphere": ("put the sphere into the bin", "put the sphere into the bin"),
    "maniskill/poke-cube": ("poke the cube to the target", "poked the cube to the target"),
    "toy/reach": ("reach the target", "reached the target"),
}
"""By task: the deed of a policy that succeeded, after *did not* and in the past."""


def done_words(task: str) -> tuple[str, str]:
    """``DONE`` of ``task``; ``succeed``, ``succeeded`` for one of a user's own."""
    return DONE.get(task, ("succeed", "succeeded"))
