"""Which tasks and camera settings there are, and ``make_env``, the one way to build them.

A *setting* is what a policy is given: which cameras, in which modalities. An environment always
draws colour and depth of every camera, so most settings only pick and name streams. Some also say
what cameras there are: ``five`` has two more, ``turned-away`` moves two, ``mixed-resolution`` draws
them at other sizes. Where a camera stands is a matter of the suite (``setting_cameras``).

A policy carries its cameras with it, so whoever loads it hands them to ``make_env`` and never needs
to know its setting, or the file in which a user described cameras of their own.

A suite is a line in ``SUITES``, which names its environment by a string: simulators are loaded when
a task of theirs is first used.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, Protocol, get_args

from madviz.envs import custom
from madviz.envs.cameras import read_cameras
from madviz.envs.tasks import MANISKILL_SUCCESS, METAWORLD_SUCCESS
from madviz.errors import UserError, unknown
from madviz.recorded.known import SUITE, check_recording, is_recording, known_recordings
from madviz.system.options import Listed
from madviz.system.plugins import load
from madviz.types import CameraSpec, Environment, EnvSpec, Modality

RenderProfile = Literal["fast", "full"]

METAWORLD_TASKS = tuple(METAWORLD_SUCCESS)
MANISKILL_TASKS = tuple(MANISKILL_SUCCESS)


class SuiteEnvironment(Protocol):
    """The class of a suite's environments."""

    setting_cameras: Mapping[str, tuple[CameraSpec, ...]]
    """By setting, the cameras that it adds or moves."""

    def __call__(
        self, task: str, render_profile: str, cameras: tuple[CameraSpec, ...]
    ) -> Environment: ...

    def describe(self, task: str, render_profile: str, cameras: tuple[CameraSpec, ...]) -> EnvSpec:
        """The facts of an environment, without building it; ``cameras`` may be empty: its own."""
        ...


@dataclass(frozen=True)
class Suite:
    """A family of tasks in one simulator."""

    tasks: tuple[str, ...]
    environment: str
    """``module:class`` of its ``SuiteEnvironment``."""
    listed: bool = True
    """True where lists name its tasks; those that are there for policies of others are left out."""


SUITES = {
    "metaworld": Suite(METAWORLD_TASKS, "madviz.envs.metaworld.environment:MetaWorld"),
    "maniskill": Suite(MANISKILL_TASKS, "madviz.envs.maniskill.environment:ManiSkill"),
    "toy": Suite(("reach",), "madviz.envs.toy:ToyReach"),
    "lerobot": Suite(
        METAWORLD_TASKS, "madviz.envs.metaworld.lerobot:LeRobotMetaWorld", listed=False
    ),
    SUITE: Suite((), "madviz.envs.recorded:RecordedRobot"),  # Its tasks are those named here.
}

TASKS = tuple(
    f"{name}/{task}" for name, suite in SUITES.items() if suite.listed for task in suite.tasks
)


def known_tasks() -> tuple[str, ...]:
    """madviz's tasks, and those of your own that were named here (``custom.py``, recordings)."""
    return (*TASKS, *custom.own_tasks(), *known_recordings())


TaskName = Annotated[str, Listed("tasks", known_tasks)]
"""An option: suite/task, or module:factory."""


def check_task(task: str) -> None:
    """Raises UserError, listing the known ones, for a task that cannot be made here."""
    if custom.is_own(task):
        custom.check_allowed(task)
        return
    if is_recording(task):
        check_recording(task)
        return
    suite, _, name = task.partition("/")
    if suite not in SUITES or name not in SUITES[suite].tasks:
        raise unknown("task", task, list(known_tasks()))


@dataclass(frozen=True)
class Setting:
    """The cameras and modalities a policy is trained with."""

    cameras: tuple[str, ...]
    modalities: tuple[Modality, ...] = ("rgb",)
    sizes: tuple[int, ...] = ()
    """Rows and columns of each camera's picture; () leaves what the suite draws."""
    elsewhere: bool = False
    """Whether some cameras stand where only a suite can say."""

    @property
    def usual(self) -> bool:
        """Whether these are a suite's own three cameras as they are, in whatever modalities."""
        return self.cameras == THREE and not self.sizes and not self.elsewhere

    @property
    def streams(self) -> tuple[str, ...]:
        """Stream names in the order of axis V; plain camera names where RGB is all there is."""
        if self.modalities == ("rgb",):
            return self.cameras
        return tuple(f"{c}.{m}" for c in self.cameras for m in self.modalities)


THREE = ("first", "third_a", "third_b")
SETTINGS: dict[str, Setting] = {
    "three": Setting(THREE),
    "three-rgbd": Setting(THREE, ("rgb", "depth")),
    "two": Setting(("first", "third_a")),
    "five": Setting((*THREE, "third_c", "top")),
    "mixed-resolution": Setting(THREE, sizes=(64, 96, 84)),
    "turned-away": Setting(THREE, elsewhere=True),
    "one-rgb": Setting(("third_a",)),
    "one-depth": Setting(("third_a",), ("depth",)),
    "one-rgbd": Setting(("third_a",), ("rgb", "depth")),
}
"""One camera is Third A, the one the paper leaves untouched where it turns the others away: it
stands still, and sees the whole table. Sizes are the paper's; a policy gets all resized to 84."""


def setting(name: str) -> Setting:
    """The setting called ``name``. Raises UserError listing the known ones."""
    if name not in SETTINGS:
        raise unknown("setting", name, list(SETTINGS))
    return SETTINGS[name]


def setting_cameras(task: str, name: str) -> tuple[CameraSpec, ...]:
    """The cameras of ``task``'s suite under the setting ``name``, ready for ``make_env``.

    Raises UserError for unknown names, and where the suite has no cameras for that setting.
    """
    own = env_spec(task).cameras
    placed = {} if custom.is_own(task) else _suite(task)[0].setting_cameras
    wanted = setting(name)
    if not _has(name, own, placed):
        known = ", ".join(other for other in SETTINGS if _has(other, own, placed))
        raise UserError(f"{task} has no cameras for the setting {name!r}; known there: {known}")
    named = {camera.name: camera for camera in (*own, *placed.get(name, ()))}
    cameras = tuple(named[camera] for camera in wanted.cameras)
    if wanted.sizes:
        sized = zip(cameras, wanted.sizes, strict=True)
        return tuple(replace(camera, size=size) for camera, size in sized)
    return cameras


def _has(
    name: str, own: tuple[CameraSpec, ...], placed: Mapping[str, tuple[CameraSpec, ...]]
) -> bool:
    """Whether a suite with its ``own`` cameras, and those ``placed`` by setting, has them all."""
    wanted = SETTINGS[name]
    here = {camera.name for camera in (*own, *placed.get(name, ()))}
    return here >= set(wanted.cameras) and (name in placed or not wanted.elsewhere)


def choose(
    task: str, name: str, file: str | Path | None = None
) -> tuple[Setting, tuple[CameraSpec, ...]]:
    """The setting and cameras to train with; or, where there is a ``file``, the user's own
    cameras in the modalities of that setting. A task of one's own has its cameras, under whatever
    names, where the setting asks for the usual three.
    Raises UserError for unknown names and bad files."""
    own = custom.is_own(task) or is_recording(task)
    wanted = setting(name)
    if is_recording(task) and (wanted.sizes or wanted.elsewhere or "depth" in wanted.modalities):
        raise UserError(
            f"expected a setting without depth, sizes and places of its own for {task}, found "
            f"{name!r}; pick three"
        )
    if file is None and not (own and wanted.usual):
        return wanted, setting_cameras(task, name)
    if file and not wanted.usual:
        raise UserError(
            f"expected --cameras without a setting that has cameras of its own, found {name!r}; "
            "leave one of them out"
        )
    cameras = read_cameras(file) if file else env_spec(task).cameras
    return Setting(tuple(c.name for c in cameras), wanted.modalities), cameras


def sees(env: EnvSpec, cameras: tuple[CameraSpec, ...]) -> bool:
    """Whether ``env`` draws all of ``cameras`` as they are described, whatever a page calls them.

    A page uses it to keep an episode going when another policy takes over.
    """
    drawn = {camera.name: replace(camera, label="") for camera in env.cameras}
    return all(drawn.get(camera.name) == replace(camera, label="") for camera in cameras)


def _suite(task: str) -> tuple[SuiteEnvironment, str]:
    """The class of a suite's environments, and the name of ``task`` there."""
    suite, _, name = task.partition("/")
    return load(SUITES[suite].environment), name


def _prepare(task: str) -> None:
    """Raises UserError for a task that cannot be made here. MuJoCo chooses its OpenGL while it is
    imported, and its own choice on Linux needs a display."""
    check_task(task)
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")


def env_spec(
    task: str, render_profile: str = "fast", cameras: tuple[CameraSpec, ...] = ()
) -> EnvSpec:
    """The ``spec`` of the environment that ``make_env`` would build, without building it; one of
    your own is built once. Raises UserError for unknown names."""
    _prepare(task)
    if custom.is_own(task):
        return custom.own_spec(task)
    environment, name = _suite(task)
    return environment.describe(name, render_profile, cameras)


def make_env(
    task: str, render_profile: str = "fast", cameras: tuple[CameraSpec, ...] = ()
) -> Environment:
    """Builds ``suite/task``, for example ``metaworld/hammer`` or ``toy/reach``.

    ``render_profile`` is ``fast`` (no shadows, reflections or multisampling: several times faster
    on a CPU) or ``full`` (the simulator's stock flags). A policy must see what it was trained on.
    ``cameras`` are the suite's own unless others are given: ``PolicySpec.cameras`` of a policy,
    ``setting_cameras`` of a setting, ``envs.cameras.read_cameras`` of a user's file.
    A task of your own is ``module:factory`` (``custom.py``).
    Raises UserError for unknown names and for a machine that cannot draw.
    """
    if render_profile not in get_args(RenderProfile):
        raise unknown("render profile", render_profile, list(get_args(RenderProfile)))
    _prepare(task)
    if custom.is_own(task):
        return custom.make_own(task, render_profile, cameras)
    environment, name = _suite(task)
    return environment(name, render_profile, cameras)
