"""What a user asks for when training, and ``resolve``, which makes a plan of it, once.

    TrainConfig -- resolve --> TrainingPlan --> a recipe

A new recipe is a file, its options (``options.RecipeOptions``) as a field of ``TrainConfig``, and
a row of ``RECIPES``.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from madviz.agent.merges.table import MERGES
from madviz.agent.methods import METHODS, Method, method
from madviz.envs.custom import allow_task
from madviz.envs.registry import SETTINGS, RenderProfile, TaskName, choose
from madviz.errors import UserError, unknown
from madviz.subsets import camera_of
from madviz.system.numbers import Seed, Threads
from madviz.system.options import OneOf, Only
from madviz.training.drawn_task import DrawnTask
from madviz.training.light import LightConfig, train_light
from madviz.training.mv_mwm import MvMwmConfig, train_mv_mwm
from madviz.training.options import RecipeOptions
from madviz.training.paper import PaperConfig, train_paper
from madviz.training.plan import TrainingPlan
from madviz.training.run_folder import RunFolder
from madviz.training.vectorised import VectorisedConfig, train_vectorised
from madviz.types import CameraSpec, EnvSpec, PolicySpec


@dataclass(frozen=True)
class Recipe:
    """A way to train."""

    options: str
    """The field of ``TrainConfig`` with its own options."""
    train: Callable[[TrainingPlan, Any, RunFolder], None]
    """Trains a plan with those options, in a folder."""


RECIPES = {
    "light": Recipe("light", train_light),
    "paper": Recipe("paper", train_paper),
    "paper-vectorised": Recipe("vectorised", train_vectorised),
    "mv-mwm": Recipe("mv_mwm", train_mv_mwm),
}


@dataclass(frozen=True)
class TrainConfig:
    """Which policy to train, how, and where to."""

    task: TaskName = "metaworld/hammer"
    """A task of madviz, or one of your own, module:factory."""
    method: Annotated[str, OneOf("method", METHODS)] = "mad"
    """What is trained on which subsets of streams; ``madviz list`` says more."""
    recipe: Annotated[str, OneOf("recipe", RECIPES)] = "light"
    """``light`` (minutes, from a scripted expert), ``paper`` (reinforcement learning),
    ``paper-vectorised`` (the same over many environments) or ``mv-mwm`` (in the imagination of a
    world model). Each has options of its own: the help shows those of the recipe that it is asked
    for with."""
    setting: Annotated[str, OneOf("setting", SETTINGS)] = "three"
    """Which cameras, and whether the policy gets colour (rgb), depth or both."""
    cameras: Path | None = None
    """A file of your own cameras, in place of the setting's (``madviz.envs.cameras``)."""
    camera: str = ""
    """For the method ``single``: the camera of the setting it learns from (else its first one)."""
    merge: Annotated[str, OneOf("merge", MERGES)] = ""
    """How streams become one feature, where a method leaves the choice; else the method's own."""
    out: Path | None = None
    """The run's folder; runs/NAME if not given."""
    seed: Seed = 1
    """Of networks, data and noise; the same seed repeats a run."""
    state: Literal["code", "paper"] = "code"
    """Proprioception: ``code`` is all the environment gives (Meta-World: 24 numbers, as in the
    paper's code), ``paper`` the 4 of its table, which other suites have not."""
    render_profile: Annotated[str, OneOf("render profile", get_args(RenderProfile))] = "fast"
    """How pictures are drawn, in training and later: ``fast`` has no shadows and reflections,
    ``full`` is the simulator's own way."""
    resume: bool = False
    """Go on with the run in ``out``."""
    threads: Threads | None = None
    """Of the learner; by default 1 for ``light``, whose recorder uses the other core, one per core
    for ``paper``, one per core without a worker for the others. Sums are split between threads, so
    another number is another run."""
    light: Annotated[LightConfig, Only("recipe", "light")] = field(default_factory=LightConfig)
    paper: Annotated[PaperConfig, Only("recipe", "paper")] = field(default_factory=PaperConfig)
    vectorised: Annotated[VectorisedConfig, Only("recipe", "paper-vectorised")] = field(
        default_factory=VectorisedConfig
    )
    mv_mwm: Annotated[MvMwmConfig, Only("recipe", "mv-mwm")] = field(default_factory=MvMwmConfig)


def resolve(config: TrainConfig) -> TrainingPlan:
    """Everything that follows from ``config``: checked, and chosen. Builds one environment, for its
    facts. Raises UserError for unknown names and for what does not go together."""
    allow_task(config.task)
    if config.recipe not in RECIPES:
        raise unknown("recipe", config.recipe, list(RECIPES))
    chosen = method(config.method)
    if config.recipe not in chosen.recipes:
        raise UserError(
            f"method {config.method!r} has the recipes {', '.join(chosen.recipes)}, "
            f"not {config.recipe!r}"
        )
    setting, cameras = choose(config.task, config.setting, config.cameras)
    camera = _one_camera(config, chosen, setting.cameras)
    streams = tuple(s for s in setting.streams if not camera or camera_of(s) == camera)
    merge = chosen.merge_for(streams, config.merge)
    drawn_task = DrawnTask(config.task, config.render_profile, cameras, streams)
    options = options_of(config)
    with closing(drawn_task.build()) as env:
        facts = env.spec
    return TrainingPlan(
        PolicySpec(
            _name(config, chosen, camera),
            config.task,
            config.method,
            config.setting,
            config.recipe,
            streams=streams,
            trained_subsets=chosen.trained_subsets(streams, options.alpha),
            render_profile=config.render_profile,
        ),
        drawn_task,
        facts,
        options.networks(facts, _state_columns(config, facts)),
        merge,
        config.seed,
        camera,
        command(config),
    )


def options_of(config: TrainConfig) -> RecipeOptions:
    """Those of the recipe that is asked for."""
    return getattr(config, RECIPES[config.recipe].options)


def _state_columns(config: TrainConfig, facts: EnvSpec) -> tuple[int, ...]:
    """The state numbers that are read; empty for all of them."""
    if config.state == "code":
        return ()
    if not facts.paper_state:
        raise UserError(
            "expected --state paper with a task with fewer numbers in the paper's table, found "
            f"{config.task}, which has none; leave it out"
        )
    return facts.paper_state


def learner_threads(config: TrainConfig) -> int:
    """As asked for, or else as many as the recipe takes on this machine."""
    return config.threads or options_of(config).threads()


def _one_camera(config: TrainConfig, chosen: Method, known: tuple[str, ...]) -> str:
    """The camera of a method that takes one; empty for all others."""
    if not chosen.one_camera:
        if config.camera:
            raise UserError(
                f"expected --camera with the method single, found it with {config.method!r}; "
                "leave it out: the method takes all cameras of its setting"
            )
        return ""
    if config.camera and config.camera not in known:
        raise unknown("camera", config.camera, list(known))
    return config.camera or known[0]


def _name(config: TrainConfig, chosen: Method, camera: str) -> str:
    """{suite}-{task}-{method}[-{merge}][-{camera}][-{setting}]-{recipe}."""
    parts = [re.sub(r"\W+", "-", config.task), config.method]
    parts += [config.merge] if config.merge not in ("", chosen.merge) else []
    parts += [camera] if camera else []
    parts += [config.setting] if config.setting != "three" else []
    parts += [config.cameras.stem] if config.cameras else []
    return "-".join([*parts, config.recipe])


def identity(config: TrainConfig, drawn: tuple[CameraSpec, ...]) -> dict[str, Any]:
    """What must be the same when a run is resumed: all but where it is, options that only change
    its time or room, and other recipes' options. Of the user's cameras, ``drawn``, it is what the
    file says that counts, not where the file is; of the threads, how many they are, not who said
    so."""
    facts = asdict(replace(config, out=None, resume=False, cameras=None))
    # Another key than the option's: older runs have that one, None where nobody said a number.
    del facts["threads"]
    facts["threads_used"] = learner_threads(config)
    for recipe in RECIPES.values():
        if recipe != RECIPES[config.recipe]:
            del facts[recipe.options]
    for option in options_of(config).ONLY_TIME:
        del facts[RECIPES[config.recipe].options][option]
    facts["cameras"] = [asdict(camera) for camera in drawn] if config.cameras else None
    return facts


def command(config: TrainConfig) -> str:
    """The line that trains this policy again."""
    default = TrainConfig()
    words = ["madviz", "train", "--task", config.task, "--method", config.method]
    words += ["--recipe", config.recipe]
    if config.cameras:
        words += ["--cameras", str(config.cameras)]
    for name in ("setting", "camera", "merge", "seed", "state", "render_profile", "threads"):
        if getattr(config, name) != getattr(default, name):
            words += [f"--{name.replace('_', '-')}", str(getattr(config, name))]
    section = RECIPES[config.recipe].options
    asked = getattr(config, section), getattr(default, section)
    words += _changed(section.replace("_", "-"), *asked)
    return shlex.join(words)


def _changed(section: str, options: Any, standard: Any) -> list[str]:
    """The words for those of ``options``, a dataclass, that are not as in ``standard``."""
    words = []
    for name, value in vars(options).items():
        usual, option = getattr(standard, name), name.replace("_", "-")
        if is_dataclass(value):
            words += _changed(f"{section}.{option}", value, usual)
        elif isinstance(value, bool) and value != usual:
            words += [f"--{section}.{'' if value else 'no-'}{option}"]
        elif value != usual:
            words += [f"--{section}.{option}", str(value)]
    return words
