"""Checks that every environment makes of what it is given."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from traceback import extract_tb

import numpy as np

from madviz.errors import UserError
from madviz.types import Array, CameraSpec, Environment, EnvSpec

MIN_SIZE = 16
MAX_SIZE = 512
"""The largest view in pixels; policies and the page need no more."""
MAX_FULL = 1024
"""That of the ``full`` render profile, for films; larger buffers cost memory."""


def check_action(action: Array, action_dim: int) -> None:
    """Raises UserError unless ``action`` is (A,) and finite; every environment calls it first."""
    numbers = np.asarray(action)
    if numbers.shape != (action_dim,) or not np.isfinite(numbers).all():
        raise UserError(
            f"expected a finite action of {action_dim} numbers in [-1, 1], found "
            f"{numbers.tolist()}; the policy that produced it is broken: reset, or pick another"
        )


def check_state(state: Array, spec: EnvSpec) -> None:
    """Raises UserError unless ``state`` is (S,), as ``spec`` says, and finite; evaluation and
    demonstrations call it at every step."""
    if np.shape(state) == (spec.state_dim,):
        if not _finite(state):
            raise UserError(
                f"expected {spec.task} to give finite state numbers, found {np.asarray(state)}; "
                "look for what it divides by, or for a simulation that has blown up"
            )
    else:
        raise UserError(
            f"expected {spec.task} to give {spec.state_dim} state numbers, as its spec says, found "
            f"the shape {np.shape(state)}; make the two alike"
        )


def check_ends(spec: EnvSpec, decisions: int, last: bool) -> None:
    """Raises UserError for an episode that goes on after the ``decisions`` that it may have."""
    if decisions >= spec.horizon and not last:
        raise UserError(
            f"expected {spec.task} to say last=True after its {spec.horizon} decisions, found an "
            "episode that goes on; make its step and its horizon agree"
        )


def expert_action(env: Environment) -> Array:
    """(A,): the decision of the task's expert. Raises UserError for a task that has none."""
    try:
        action = env.expert()
    except UserError:
        raise
    except Exception as error:  # A task of one's own may raise anything.
        where = extract_tb(error.__traceback__)[-1]
        raise UserError(
            f"expected an expert of {env.spec.task}, found {type(error).__name__}: {error} "
            f"({Path(where.filename).name}, line {where.lineno}); write or repair it, or train "
            "by rewards (--recipe paper)"
        ) from error
    if np.shape(action) != (env.spec.action_dim,) or not _finite(action):
        raise UserError(
            f"expected {env.spec.action_dim} finite numbers of the expert of {env.spec.task}, "
            f"found {np.asarray(action).tolist()}; repair it, or the task's action_dim"
        )
    return action


def _finite(numbers: object) -> bool:
    """False also for what holds no numbers."""
    try:
        return bool(np.isfinite(np.asarray(numbers, np.float64)).all())
    except (TypeError, ValueError):
        return False


def largest_view(render_profile: str) -> int:
    """The most pixels that a side of a view may have."""
    return MAX_FULL if render_profile == "full" else MAX_SIZE


def check_size(size: int, most: int = MAX_SIZE) -> None:
    """Raises UserError for a view that cannot be drawn; ``size`` and ``most`` in pixels."""
    if not 1 <= size <= most:
        raise UserError(f"a view must have 1 to {most} pixels a side, found {size}")


def resized_cameras(
    task: str, own: tuple[CameraSpec, ...], given: tuple[CameraSpec, ...]
) -> tuple[CameraSpec, ...]:
    """``own`` in the sizes of ``given``, for tasks whose cameras cannot be placed anew. Raises
    UserError for a camera with another name, or at another place."""
    cameras = {camera.name: camera for camera in own}
    for camera in given:
        if camera.name not in cameras or not _same_place(cameras[camera.name], camera):
            raise UserError(
                f"{task} has the cameras {', '.join(cameras)} where they are, and no others; found "
                f"{camera.name!r} placed elsewhere; leave it out, or take a task of Meta-World or "
                "ManiSkill"
            )
    cameras |= {one.name: replace(cameras[one.name], size=one.size) for one in given}
    return tuple(cameras.values())


def _same_place(own: CameraSpec, given: CameraSpec) -> bool:
    """True where the numbers of ``given`` are those of ``own``, as far as a file writes them."""
    numbers = [
        np.array([*one.position, *one.wxyz, one.fovy, *one.depth_range]) for one in (own, given)
    ]
    return own.body == given.body and bool(np.allclose(*numbers, atol=1e-4, rtol=0))
