"""Tasks of your own: ``--task module:factory``, which returns a ``madviz.types.Environment``.

The problem: a task's name also stands in files (a policy's config, a kept session, a sweep) and
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
from dataclasses import replace

from madviz.errors import UserError
from madviz.system.plugins import made_by
from madviz.types import CameraSpec, Environment, EnvSpec

VARIABLE = "MADVIZ_TASKS"
PARTS = (
    *("spec", "reset", "step", "view", "pose", "move_camera"),
    *("bodies", "body_poses", "hand", "expert", "close"),
)


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


def make_own(task: str, render_profile: str, cameras: tuple[CameraSpec, ...]) -> Environment:
    """The factory's environment under the name ``task``. Raises UserError for one that was not
    named, lacks a part, or draws otherwise than asked."""
    check_allowed(task)
    made = made_by(task, "an environment (madviz.types.Environment)", PARTS)
    spec = made.spec
    if not isinstance(spec, EnvSpec):
        raise UserError(
            f"{task}: expected a spec of the kind madviz.types.EnvSpec, found a "
            f"{type(spec).__name__}; fill one in"
        )
    if spec.render_profile != render_profile:
        made.close()
        raise UserError(
            f"{task} draws with the render profile {spec.render_profile!r} alone, found "
            f"{render_profile!r}; pick the former"
        )
    made.spec = replace(spec, task=task, cameras=cameras_in_place(task, spec.cameras, cameras))
    return made


def cameras_in_place(
    task: str, own: tuple[CameraSpec, ...], given: tuple[CameraSpec, ...]
) -> tuple[CameraSpec, ...]:
    """``own`` in the sizes of ``given``, for worlds whose cameras stand where they stand. Raises
    UserError for a camera that is another one, or elsewhere."""
    places = {camera.name: camera for camera in own}
    for camera in given:
        if camera.name not in places or replace(places[camera.name], size=camera.size) != camera:
            raise UserError(
                f"{task} has the cameras {', '.join(places)} where they are, and no others; found "
                f"{camera.name!r} placed elsewhere; leave it out, or take a task of Meta-World or "
                "ManiSkill"
            )
    places |= {camera.name: camera for camera in given}
    return tuple(places.values())
