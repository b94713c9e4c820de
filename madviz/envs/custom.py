"""Tasks of your own: ``--task module:factory``, which returns a ``madviz.types.Environment``.

The problem: a task's name also stands in files (a policy's config, a saved session, a sweep) and
comes from pages. Who imports the module that a file names runs the code of whoever wrote the file.

The idea: a task of your own is known only where you have named it yourself, as ``--task`` of
``train`` or ``explore`` does, or in ``MADVIZ_TASKS``, names with commas between. It is an
environment variable because worker processes inherit those: what is known here is known there.

    madviz train --task my_tasks:make_push --out runs/push      names it
    export MADVIZ_TASKS=my_tasks:make_push                      names it for all that follows
    madviz eval --policy runs/push
"""

from __future__ import annotations

import os
import re
from dataclasses import replace

from madviz.envs.cameras import RESERVED
from madviz.envs.checks import MAX_SIZE, MIN_SIZE, resized_cameras
from madviz.errors import UserError
from madviz.system.plugins import made_by
from madviz.types import CameraSpec, Environment, EnvSpec

VARIABLE = "MADVIZ_TASKS"
_SPECS: dict[str, EnvSpec] = {}
"""For each factory that was called in this process, the facts of its last environment."""


def is_own(task: str) -> bool:
    """Whether the name means a factory, and not a task of madviz."""
    return ":" in task


def own_tasks() -> tuple[str, ...]:
    """Those that were named here."""
    listed = os.environ.get(VARIABLE, "").split(",")
    return tuple(dict.fromkeys(task.strip() for task in listed if is_own(task)))


def allow_task(task: str | None) -> None:
    """Makes a task of one's own known to this process and all that it starts; of any other name,
    nothing needs to be said."""
    if task and is_own(task):
        os.environ[VARIABLE] = ",".join(dict.fromkeys((*own_tasks(), task)))


def check_allowed(task: str) -> None:
    """Raises UserError for a task that nobody has named here."""
    if task not in own_tasks():
        raise UserError(
            f"the task {task} is a module that nobody has named here, found "
            f"{', '.join(own_tasks()) or 'none'}; if you trust it, set {VARIABLE}={task} and try "
            "again: it will be imported and run"
        )


def own_spec(task: str) -> EnvSpec:
    """The facts of the factory's environment; it is built once to ask it, if it was never
    built before. Raises UserError as ``make_own`` does."""
    check_allowed(task)
    if task not in _SPECS:
        made = _made(task)
        made.close()
    return _SPECS[task]


def make_own(task: str, render_profile: str, cameras: tuple[CameraSpec, ...]) -> Environment:
    """The factory's environment under the name ``task``. Raises UserError for one that was not
    named, lacks a part, or draws otherwise than asked."""
    check_allowed(task)
    made = _made(task)
    spec = _SPECS[task]
    if spec.render_profile != render_profile:
        made.close()
        raise UserError(
            f"{task} draws with the render profile {spec.render_profile!r} alone, found "
            f"{render_profile!r}; pick the former"
        )
    try:
        made.spec = replace(spec, cameras=resized_cameras(task, spec.cameras, cameras))
    except AttributeError as error:
        made.close()
        raise UserError(
            f"{task}: expected an attribute spec that can be set, found none ({error}); set "
            "self.spec where it is made"
        ) from error
    return made


def _made(task: str) -> Environment:
    """A new environment of the factory; ``_SPECS`` has its spec."""
    made = made_by(task, Environment)
    try:
        _check_spec(task, made.spec)
    except UserError:
        made.close()
        raise
    _SPECS[task] = replace(made.spec, task=task)
    return made


def _check_spec(task: str, spec: EnvSpec) -> None:
    """Raises UserError for cameras that no subset could name or no policy could have, and for
    columns of the state that it does not have."""
    names = [camera.name for camera in spec.cameras]
    for name in names:
        if name in RESERVED or not re.fullmatch(r"\w{1,40}", name) or names.count(name) > 1:
            raise UserError(
                f"{task}: expected cameras whose names have letters, digits and _ alone, each "
                f"once, none of them {', '.join(RESERVED)}; found {name!r:.60}; rename it"
            )
    for camera in spec.cameras:
        if not MIN_SIZE <= camera.size <= MAX_SIZE:
            raise UserError(
                f"{task}: expected cameras of {MIN_SIZE} to {MAX_SIZE} pixels a side, found "
                f"{camera.name} of {camera.size}"
            )
    for number in spec.state_numbers.named:
        if not 0 <= number < spec.state_dim:
            raise UserError(
                f"{task}: expected state_numbers from 0 to {spec.state_dim - 1}, found {number}"
            )
