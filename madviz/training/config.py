"""The request for a training, and ``resolve``, which makes a plan of it, once.

    TrainConfig -- resolve --> TrainingPlan --> a recipe

The fields of ``TrainConfig`` are the table of recipes: one line with a recipe's options
(``runs/recipe_options.py``), its name and its function. A method's own options are in ``own``.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

from madviz.agent.merges.merge_table import MERGES, own_options
from madviz.agent.methods import METHODS, Method, method
from madviz.agent.sizes import NetworkConfig, OwnOptions
from madviz.envs.custom import allow_task, is_own
from madviz.envs.registry import SETTINGS, RenderProfile, TaskName, choose
from madviz.errors import UserError, unknown
from madviz.recorded.known import allow_recording, is_recording, recordings_of
from madviz.runs.drawn_task import DrawnTask
from madviz.runs.recipe_options import RecipeOptions
from madviz.runs.run_folder import RunFolder
from madviz.runs.training_plan import TrainingPlan
from madviz.subsets import camera_of
from madviz.system.machine import cores
from madviz.system.numbers import Seed, Threads
from madviz.system.options import OneOf, Only, changed, words_for
from madviz.training.light_options import LightConfig
from madviz.training.paper import PaperConfig, train_paper
from madviz.training.recorded import imitate
from madviz.training.vectorised import VectorisedConfig, train_vectorised
from madviz.types import EnvSpec, PolicySpec
from madviz.world_model.mv_mwm_options import MvMwmConfig
from madviz.world_model.recipe import train_mv_mwm
from madviz.world_model.sizes import AutoencoderConfig


@dataclass(frozen=True)
class Recipe:
    """A way to train; it annotates the field of ``TrainConfig`` that has its options."""

    name: str
    train: Callable[[TrainingPlan, Any, RunFolder], None]
    """Trains a plan with those options, in a folder."""
    options: str = ""
    """The name of that field."""


RECIPES: dict[str, Recipe] = {}
"""Every recipe by name: read off the fields of ``TrainConfig``, below it."""


@dataclass(frozen=True)
class TrainConfig:
    """Which policy to train, how, and where to."""

    task: TaskName = "metaworld/hammer"
    """A task of madviz, or one of your own, module:factory."""
    method: Annotated[str, OneOf("method", METHODS)] = "mad"
    """Which subsets of streams are trained, and how; ``madviz list`` says more."""
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
    """Seeds networks, data and noise; the same seed repeats a run."""
    state: Literal["code", "paper", "no-start"] = "code"
    """Proprioception: ``code`` is all the environment gives (Meta-World: 24 numbers, as in the
    paper's code), ``paper`` the 4 of its table, which other suites have not, ``no-start`` all but
    those that tell where PushCube's or PullCube's cube began."""
    render_profile: Annotated[str, OneOf("render profile", get_args(RenderProfile))] = "fast"
    """How pictures are drawn, in training and later: ``fast`` has no shadows and reflections,
    ``full`` is the simulator's own way."""
    resume: bool = False
    """Go on with the run in ``out``."""
    threads: Threads | None = None
    """Threads of the learner; by default 1 for ``light``, whose recorder uses the other core, one
    per core for ``paper`` and with ``--recording``, one per core without a worker for the others
    (both of two cores). Sums are split between threads, so another number is another run."""
    own: OwnOptions = field(default_factory=OwnOptions)
    """Options of the method's merge, if it has any."""
    light: Annotated[LightConfig, Recipe("light", imitate), Only("recipe", "light")] = field(
        default_factory=LightConfig
    )
    paper: Annotated[PaperConfig, Recipe("paper", train_paper), Only("recipe", "paper")] = field(
        default_factory=PaperConfig
    )
    vectorised: Annotated[
        VectorisedConfig,
        Recipe("paper-vectorised", train_vectorised),
        Only("recipe", "paper-vectorised"),
    ] = field(default_factory=VectorisedConfig)
    mv_mwm: Annotated[MvMwmConfig, Recipe("mv-mwm", train_mv_mwm), Only("recipe", "mv-mwm")] = (
        field(default_factory=MvMwmConfig)
    )
    recording: Path | None = None
    """Recordings of your own robot, a LeRobot dataset, to learn from in place of a task: by the
    recipe ``light``, without a simulator. Nothing is played, so no success is counted."""

    @staticmethod
    def renamed_options() -> dict[str, str]:
        """Older spellings of options -> today's: a method's own were once those of recipes."""
        names = ["bottleneck-dim", "kl-weight"]
        renamed = {f"--{s}.{n}": f"--own.{n}" for s in ("paper", "vectorised") for n in names}
        sizes = [size.name.replace("_", "-") for size in fields(AutoencoderConfig)]
        names += ["reconstructed", "end-to-end", "no-end-to-end", "autoencoder.no-view-masking"]
        names += [f"autoencoder.{size}" for size in sizes]
        return renamed | {f"--light.{name}": f"--own.{name}" for name in names}


def _recipes() -> Iterator[Recipe]:
    for name, kind in get_type_hints(TrainConfig, include_extras=True).items():
        for note in getattr(kind, "__metadata__", ()):
            if isinstance(note, Recipe):
                yield replace(note, options=name)


RECIPES.update({recipe.name: recipe for recipe in _recipes()})


def default_config(words: Sequence[str]) -> TrainConfig:
    """The values that a command line changes: ``own`` has the options of the method that ``words``
    choose, with the defaults of their recipe, so that a reader of types finds these options. Raises
    UserError for an option of another recipe, or of a method that has none."""
    chosen = {"--method": "mad", "--merge": "", "--recipe": "light"}
    for word, following in zip(words, [*words, ""][1:], strict=True):
        option, joined, value = word.partition("=")
        if option in chosen:
            chosen[option] = value if joined else following
    row = METHODS.get(chosen["--method"])
    merge = chosen["--merge"] or (row.merge if row else "")
    own = _default_own(merge, chosen["--recipe"])
    for option in (word.partition("=")[0] for word in words):
        option = TrainConfig.renamed_options().get(option, option)
        recipe = recipe_of(option.removeprefix("--")) if option.startswith("--") else None
        if recipe not in (None, chosen["--recipe"]):
            raise UserError(
                f"expected {option:.60} with --recipe {recipe}, found it with the recipe "
                f"{chosen['--recipe']!r:.60}, which has no use for it; leave it out"
            )
        if option.startswith("--own.") and type(own) is OwnOptions:
            having = [name for name in MERGES if own_options(name).of_recipe("") != own]
            raise UserError(
                f"expected {option:.60} with a method that has options of its own "
                f"({', '.join(having)}), found it with {chosen['--method']!r}; leave it out"
            )
    return TrainConfig(own=own)


def recipe_of(option: str) -> str | None:
    """The only recipe that uses ``light.rounds`` and the like; None for an option of all."""
    section, dot, _ = option.replace("_", "-").partition(".")
    names = {recipe.options.replace("_", "-"): name for name, recipe in RECIPES.items()}
    return names.get(section) if dot else None


def _default_own(merge: str, recipe: str) -> OwnOptions:
    return own_options(merge).of_recipe(recipe) if merge in MERGES else OwnOptions()


def resolve(config: TrainConfig) -> TrainingPlan:
    """Everything that follows from ``config``: checked, and chosen. Builds one environment, for its
    facts. Raises UserError for unknown names and for what does not go together."""
    allow_task(config.task)
    if config.recipe not in RECIPES:
        raise unknown("recipe", config.recipe, list(RECIPES))
    if is_recording(config.task) and config.recipe != "light":
        raise UserError(
            f"expected the recipe light for recordings, found {config.recipe!r}, which learns from "
            "playing; leave --recipe out"
        )
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
        _networks(config, options, facts, merge),
        merge,
        config.seed,
        camera,
        command(config),
    )


def _networks(
    config: TrainConfig, options: RecipeOptions, facts: EnvSpec, merge: str
) -> NetworkConfig:
    """The sizes of all networks: the recipe's, and the method's own as they are asked for."""
    networks = options.networks(facts, _state_columns(config, facts))
    kind = own_options(merge)
    asked = config.own
    if type(asked) not in (OwnOptions, kind):
        raise UserError(
            f"expected the own options of the merge {merge!r}, which are "
            f"{'none' if kind is OwnOptions else kind.__name__}, found {type(asked).__name__}; "
            "leave them out, or pick their method"
        )
    if type(asked) is OwnOptions and type(networks.own) is OwnOptions:
        asked = _default_own(merge, config.recipe)
    return networks if type(asked) is OwnOptions else replace(networks, own=asked)


def options_of(config: TrainConfig) -> RecipeOptions:
    """Those of the recipe that is asked for."""
    return getattr(config, RECIPES[config.recipe].options)


def _state_columns(config: TrainConfig, facts: EnvSpec) -> tuple[int, ...]:
    """The state numbers that are read; empty for all of them."""
    if config.state == "code":
        return ()
    numbers = facts.state_numbers
    if config.state == "no-start":
        if not numbers.start:
            raise UserError(
                "expected --state no-start with a task whose state tells where the object began "
                f"(maniskill/push-cube, maniskill/pull-cube), found {config.task}; leave it out"
            )
        return tuple(n for n in range(facts.state_dim) if n not in numbers.start)
    if not numbers.paper:
        raise UserError(
            "expected --state paper with a task with fewer numbers in the paper's table, found "
            f"{config.task}, which has none; leave it out"
        )
    return numbers.paper


def learner_threads(config: TrainConfig) -> int:
    """As asked for, or else as many as the recipe takes on this machine."""
    # Nothing records beside a training on recordings.
    recorded = cores() if is_recording(config.task) else None
    return config.threads or recorded or options_of(config).threads()


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


OWN_FACTS = ("cameras", "state_dim", "action_dim", "horizon", "action_repeat")
"""Fields of an own task's ``EnvSpec`` that a run depends on."""


def identity(config: TrainConfig, plan: TrainingPlan) -> dict[str, Any]:
    """The facts that a resumed run must share: all but where it is, options that only change
    its time or room, and other recipes' options. Of the user's cameras it is what the file says
    that counts, not where the file is; of an own task, its cameras and sizes as they are now; of
    the threads, how many they are, not who said so."""
    facts = asdict(replace(config, out=None, resume=False, cameras=None, recording=None))
    # Another key than the option's: older runs have that one, None where nobody said a number.
    del facts["threads"]
    facts["threads_used"] = learner_threads(config)
    for recipe in RECIPES.values():
        if recipe != RECIPES[config.recipe]:
            del facts[recipe.options]
    for option in options_of(config).ONLY_TIME:
        del facts[RECIPES[config.recipe].options][option]
    drawn = plan.drawn_task.cameras if config.cameras else None
    facts["cameras"] = drawn and [asdict(camera) for camera in drawn]
    if is_own(config.task):
        facts["own_task"] = {name: asdict(plan.env)[name] for name in OWN_FACTS}
    if is_recording(config.task):
        found = recordings_of(config.task)
        facts["recorded"] = [[one.index, one.length] for one in found.episodes]
        facts["scalings"] = [scaling.to_json() for scaling in found.scalings()]
        facts["held_out"] = list(found.held_out)
        facts["recorded_numbers"] = found.whole
        facts["recorded_cameras"] = [asdict(camera) for camera in found.cameras]
    return facts


def with_recording(config: TrainConfig) -> TrainConfig:
    """``config`` with the task of its recordings. Raises UserError beside another task, and for
    recordings of no use."""
    if config.recording is None:
        return config
    task = allow_recording(config.recording)
    if config.task not in (TrainConfig.task, task):
        raise UserError(f"expected --recording without --task, found {config.task}; leave it out")
    return replace(config, task=task)


def command(config: TrainConfig, given_away: bool = True) -> str:
    """The line that trains this policy again; if it is ``given_away``, with the last part alone of
    the path of recordings, and of paths from the root."""
    usual = TrainConfig(own=type(config.own).of_recipe(config.recipe))
    asked: dict[str, Any] = {"task": config.task, "method": config.method, "recipe": config.recipe}
    asked |= changed(replace(config, out=None, resume=False), usual)
    if config.recording is not None:
        del asked["task"]
        asked["recording"] = config.task.partition("/")[2] if given_away else config.recording
    for name in ("cameras", "light.episodes"):
        if given_away and Path(asked.get(name) or "").is_absolute():
            asked[name] = Path(asked[name]).name
    here = (None, config.recipe)
    words = words_for({name: value for name, value in asked.items() if recipe_of(name) in here})
    return shlex.join(["madviz", "train", *words])
