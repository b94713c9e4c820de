"""``train``: one way in for every recipe; composes environment, agent, run folder and loop.

    light              minutes on two cores, by imitating an expert   training/light.py
    paper              the paper's reinforcement learning, exactly    training/paper.py
    paper-vectorised   the same losses over many environments         training/vectorised.py

The folder given with --out is a policy folder from the first checkpoint on: explore it, evaluate
it, copy it to checkpoints/. Ctrl-C finishes the round, saves, and says how to go on."""

from __future__ import annotations

import os
import re
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch

from madviz.agent.agent import Agent
from madviz.agent.methods import method
from madviz.agent.networks import FEATURE_SIZE, NetworkConfig
from madviz.envs.custom import allow_task
from madviz.envs.registry import choose, make_env
from madviz.errors import UserError, unknown
from madviz.policies.checkpoint import save_policy
from madviz.policies.config import TrainingRecord, policy_config
from madviz.subsets import camera_of
from madviz.system.processes import reuse_large_blocks
from madviz.training.light import LightConfig, LightRun, Recorder, train_light
from madviz.training.light_critic import REWARD_SCALE, fit_critic
from madviz.training.paper import PaperConfig, train_paper
from madviz.training.run_folder import Event, RunFolder
from madviz.training.vectorised import VectorisedConfig, train_vectorised
from madviz.types import CameraSpec, EnvSpec, PolicySpec

RECIPES = {"light": "light", "paper": "paper", "paper-vectorised": "vectorised"}
"""Each with the field of ``TrainConfig`` that holds its own options."""


@dataclass(frozen=True)
class TrainConfig:
    """Which policy to train, how, and where to."""

    task: str = "metaworld/hammer"
    """suite/task; ``madviz list`` shows them. Or one of your own, module:factory."""
    method: str = "mad"
    """What is trained on which subsets of streams."""
    recipe: str = "light"
    """``light`` (minutes, from a scripted expert), ``paper`` (reinforcement learning) or
    ``paper-vectorised`` (the same over many environments)."""
    setting: str = "three"
    """Cameras and modalities."""
    cameras: Path | None = None
    """A file of your own cameras, in place of the setting's (``madviz.envs.cameras``)."""
    camera: str = ""
    """For the method ``single``: the camera of the setting it learns from (else its first one)."""
    merge: str = ""
    """How streams become one feature, where a method leaves the choice; else the method's own."""
    out: Path | None = None
    """The run's folder; runs/NAME if not given."""
    seed: int = 1
    """Of networks, data and noise; the same seed repeats a run."""
    state: Literal["code", "paper"] = "code"
    """Proprioception: ``code`` is all the environment gives (Meta-World: 24 numbers, as in the
    paper's code), ``paper`` the 4 of its table."""
    render_profile: str = "fast"
    """What the policy sees, now and for ever."""
    resume: bool = False
    """Go on with the run in ``out``."""
    threads: int | None = None
    """Of the learner; by default 1 for ``light``, whose recorder uses the other core, one per core
    for ``paper``, one per core without a worker for ``paper-vectorised``. Sums are split between
    threads, so another number is another run."""
    light: LightConfig = field(default_factory=LightConfig)
    paper: PaperConfig = field(default_factory=PaperConfig)
    vectorised: VectorisedConfig = field(default_factory=VectorisedConfig)

    def policy_spec(self) -> PolicySpec:
        """What the trained policy will say of itself."""
        streams = self.streams()
        return PolicySpec(
            *(self.policy_name(), self.task, self.method, self.setting, self.recipe),
            streams=streams,
            trained_subsets=method(self.method).trained_subsets(streams),
            render_profile=self.render_profile,
        )

    def chosen_camera(self) -> str:
        """The one camera of a method that takes one; empty for all others.

        Raises UserError for a camera that the setting lacks or the method has no use for.
        """
        known = choose(self.task, self.setting, self.cameras)[0].cameras
        if not method(self.method).one_camera:
            if self.camera:
                raise UserError(
                    f"expected --camera with the method single, found it with {self.method!r}; "
                    "leave it out: the method takes all cameras of its setting"
                )
            return ""
        if self.camera and self.camera not in known:
            raise unknown("camera", self.camera, list(known))
        return self.camera or known[0]

    def streams(self) -> tuple[str, ...]:
        """What the policy is given: the setting's streams, or those of its one camera."""
        camera = self.chosen_camera()
        streams = choose(self.task, self.setting, self.cameras)[0].streams
        return tuple(s for s in streams if not camera or camera_of(s) == camera)

    def drawn(self) -> tuple[CameraSpec, ...]:
        """The cameras of the setting, or of the user's file."""
        return choose(self.task, self.setting, self.cameras)[1]

    def networks(
        self, env: EnvSpec, hidden_dim: int, bottleneck_dim: int = FEATURE_SIZE
    ) -> NetworkConfig:
        """Sizes for ``env``, and which of its state numbers the heads read."""
        return NetworkConfig(
            *(env.state_dim, env.action_dim),
            hidden_dim=hidden_dim,
            bottleneck_dim=bottleneck_dim,
            state_columns=env.paper_state if self.state == "paper" else (),
        )

    def identity(self) -> dict[str, Any]:
        """What must be the same when a run is resumed: all but where it is, how many processes
        step its environments, and other recipes' options. Of the user's cameras it is what the
        file says that counts, not where the file is."""
        facts = asdict(replace(self, out=None, resume=False, cameras=None))
        for section in RECIPES.values():
            if section != RECIPES[self.recipe]:
                del facts[section]
        facts.get("vectorised", {}).pop("workers", None)
        facts["cameras"] = [asdict(c) for c in self.drawn()] if self.cameras else None
        return facts

    def policy_name(self) -> str:
        """{suite}-{task}-{method}[-{merge}][-{camera}][-{setting}]-{recipe}."""
        own = method(self.method).merge
        parts = [re.sub(r"\W+", "-", self.task), self.method]
        parts += [self.merge] if self.merge not in ("", own) else []
        parts += [self.chosen_camera()] if self.chosen_camera() else []
        parts += [self.setting] if self.setting != "three" else []
        parts += [self.cameras.stem] if self.cameras else []
        return "-".join([*parts, self.recipe])


def train(config: TrainConfig, listener: Callable[[Event], None] | None = None) -> Path:
    """Trains and returns the policy's folder. Events go to ``listener``, by default one line each
    on standard error. Raises UserError for unknown names and for a folder that holds another run.
    """
    allow_task(config.task)
    if config.recipe not in RECIPES:
        raise unknown("recipe", config.recipe, list(RECIPES))
    chosen = method(config.method)
    if config.recipe not in chosen.recipes:
        raise UserError(
            f"method {config.method!r} has the recipes {', '.join(chosen.recipes)}, "
            f"not {config.recipe!r}"
        )
    chosen.merge_for(config.streams(), config.merge)
    if config.recipe == "paper-vectorised":
        config.vectorised.prepare(config.task)
    make_env(config.task, config.render_profile, config.drawn()).close()
    reuse_large_blocks()
    everything = os.cpu_count() or 1
    threads = {"light": 1, "paper": everything}.get(config.recipe)
    torch.set_num_threads(
        config.threads or threads or max(1, everything - config.vectorised.processes())
    )
    out = config.out or Path("runs") / config.policy_name()
    folder = RunFolder(out, config.identity(), config.resume, listener or print_event)
    if folder.finished:
        folder.finish()  # Again: the first time may have been cut off.
        folder.report("done", seconds=0.0, path=str(folder.path))
        return folder.path
    try:
        if config.recipe == "paper":
            train_paper(config, folder, command(config))
        elif config.recipe == "paper-vectorised":
            train_vectorised(config, folder, command(config))
        else:
            _train_light(config, folder)
    except UserError:
        folder.forget()
        raise
    return folder.path


def _train_light(config: TrainConfig, folder: RunFolder) -> None:
    env = make_env(config.task, config.render_profile, config.drawn())
    facts = env.spec
    env.close()
    spec = config.policy_spec()
    torch.manual_seed(config.seed)
    networks = config.networks(facts, config.light.hidden_dim, config.light.bottleneck_dim)
    merge = method(config.method).merge_for(spec.streams, config.merge)
    agent = Agent(networks, merge=merge, streams=spec.streams)
    run = LightRun(config.light, spec, agent, facts.horizon, config.seed, folder.resume)
    state = folder.load_state()
    if state:
        run.restore(state)
        folder.truncate_curve("round", run.round)
    recorder = Recorder(
        *(config.task, config.render_profile, config.drawn()), spec.streams, config.light.workers
    )
    started = time.monotonic()
    try:
        train_light(
            run, folder, recorder, lambda run, final: _save(config, facts, run, folder, final)
        )
    finally:
        recorder.close()
    folder.report("done", seconds=round(time.monotonic() - started, 1), path=str(folder.path))


def _save(
    config: TrainConfig, facts: EnvSpec, run: LightRun, folder: RunFolder, final: bool
) -> None:
    """Writes the averaged weights as a policy; the critic is fitted when nothing else changes."""
    began = time.monotonic()
    updates = config.light.critic_updates if final else 0
    if updates:
        chosen = method(config.method)
        fit_critic(run.average, run.data, chosen, config.light.alpha, updates, config.seed)
    training = TrainingRecord(
        how="imitation of a scripted expert that labels the student's own states; "
        "not reinforcement learning from scratch",
        command=command(config),
        expert_demonstrations=config.light.demonstrations,
        labelled_episodes=run.data.episodes,
        environment_steps=len(run.data) * facts.action_repeat,
        updates=run.updates,
        critic_updates=updates,
        batch_size=config.light.batch_size,
        alpha=config.light.alpha,
        seeds=f"network and data {config.seed}, episodes below 1000",
        wall_time_s=round(run.seconds + time.monotonic() - began),
        finished=final,
    )
    described = policy_config(
        run.spec,
        facts,
        run.agent.config,
        training,
        merge=run.agent.merge_name,
        camera=config.chosen_camera(),
        reward_scale=REWARD_SCALE,
    )
    save_policy(folder.path, run.average, described)


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
    section = RECIPES[config.recipe]
    standard = getattr(default, section)
    for name, value in vars(getattr(config, section)).items():
        if isinstance(value, bool) and value != getattr(standard, name):
            words += [f"--{section}.{'' if value else 'no-'}{name.replace('_', '-')}"]
        elif value != getattr(standard, name):
            words += [f"--{section}.{name.replace('_', '-')}", str(value)]
    return shlex.join(words)


def print_event(event: Event) -> None:
    """One line on standard error."""
    words = [f"{key} {value}" for key, value in event.items() if key != "kind"]
    print("  ".join([f"[{event['kind']}]", *words]), file=sys.stderr, flush=True)
