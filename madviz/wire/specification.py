"""The conventions that a server of vla-eval says in its greeting, against those of the wire file.

    action_spec         {"position": {"dims": 3, "format": "delta_xyz"}, "gripper": {...}}
    observation_spec    {"image": {"dims": 0, "format": "rgb_hwc_uint8"}, "state": {...}}

``dims`` of 0 and the format ``raw`` say nothing. What is said and does not fit is refused by name,
before the first episode.
"""

from __future__ import annotations

from typing import Any

import msgspec

from madviz.errors import UserError
from madviz.system.typed import typed
from madviz.types import EnvSpec
from madviz.wire.wiring import Wiring


class SpecificationPart(msgspec.Struct, frozen=True):
    """A part of an action or of a look, as vla-eval describes it."""

    dims: int = 0
    """Numbers in it; 0: not said, or a picture."""
    format: str = ""


class Specification(msgspec.Struct, frozen=True):
    """The two descriptions of a greeting; empty where it has none."""

    action_spec: dict[str, SpecificationPart] = {}
    observation_spec: dict[str, SpecificationPart] = {}


def check_specification(greeting: dict[str, Any], wiring: Wiring, env: EnvSpec, where: str) -> None:
    """Raises UserError where the server behind ``greeting`` says another convention than
    ``wiring``."""
    found = typed(
        {key: greeting[key] for key in Specification.__struct_fields__ if greeting.get(key)},
        Specification,
        where,
        "see vla-eval's DimSpec",
    )
    for problem in (*_action(found.action_spec, wiring, env), *_look(found, wiring, env)):
        raise UserError(f"{where}: expected {problem}")


def _action(parts: dict[str, SpecificationPart], wiring: Wiring, env: EnvSpec) -> list[str]:
    problems = []
    dims = [part.dims for part in parts.values()]
    if dims and all(dims) and sum(dims) != env.action_dim:
        named = ", ".join(f"{name!r:.40} of {part.dims}" for name, part in parts.items())
        problems.append(
            f"actions of {env.action_dim} numbers for {env.task}, found {sum(dims)} ({named}); "
            "serve a policy for this task"
        )
    for name, part in parts.items():
        said = part.format
        if said in ("delta_xyz", "absolute_xyz"):
            here = "delta_xyz" if wiring.absolute is None else "absolute_xyz"
            if said != here:
                move = "say absolute in --wire" if here == "delta_xyz" else "drop absolute"
                problems.append(f"{name!r:.40} as {here}, found {said}; {move}")
        elif said in ("continuous_01", "binary_close_01"):
            problems.append(f"{name!r:.40} from -1 to 1, found {said}; map it in the server")
        elif said in ("binary_close_positive", "binary_close_negative") and env.gripper:
            inverted = wiring.gripper_inverted != (wiring.action_sign[-1:] == [-1])
            positive = (env.gripper == "closes at 1") != inverted
            here = f"binary_close_{'positive' if positive else 'negative'}"
            if said != here:
                move = f"gripper_inverted = {'false' if wiring.gripper_inverted else 'true'}"
                problems.append(f"{name!r:.40} as {here}, found {said}; say {move} in --wire")
    return problems


def _look(found: Specification, wiring: Wiring, env: EnvSpec) -> list[str]:
    problems = []
    for name, part in found.observation_spec.items():
        said = part.format
        if said[:3] in ("rgb", "bgr") and said[:3] != wiring.channels:
            move = f'say channels = "{said[:3]}" in --wire'
            problems.append(f"{name!r:.40} as {wiring.channels}, found {said!r:.40}; {move}")
        if said.endswith("uint8") and wiring.values != "0-255":
            move = 'say values = "0-255" in --wire'
            problems.append(f"{name!r:.40} from 0 to 1, found {said!r:.40}; {move}")
        if name == "state":
            sent = 0 if wiring.state == "" else len(wiring.state_order) or env.state_dim
            if not sent:
                problems.append("no state, found that the server takes one; give 'state' its key")
            elif part.dims not in (0, sent):
                problems.append(
                    f"a state of {sent} numbers, found {part.dims}; see state_order in --wire"
                )
    return problems
