"""``train``: one way in for every recipe; composes environment, agent, run folder and loop.

    light   minutes on two cores, by imitating a scripted expert       madviz/light.py
    paper   the paper's reinforcement learning, exactly                madviz/paper.py

The folder given with --out is a policy folder from the first checkpoint on: explore it, evaluate
it, copy it to checkpoints/. Ctrl-C finishes the round, saves, and says how to go on."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch

from madviz.agent.agent import Agent
from madviz.agent.methods import method
from madviz.agent.networks import NetworkConfig
from madviz.checkpoint import save_policy
from madviz.envs.base import make_env, setting
from madviz.light import LightConfig, LightRun, Recorder, train_light
from madviz.light_critic import REWARD_SCALE, fit_critic
from madviz.manifest import policy_config
from madviz.paper import PaperConfig, train_paper
from madviz.run import Event, RunFolder
from madviz.types import EnvSpec, PolicySpec, UserError, unknown

RECIPES = ("light", "paper")


@dataclass(frozen=True)
class TrainConfig:
    """Which policy to train, how, and where to."""

    task: str = "metaworld/hammer"
    """suite/task; ``madviz list`` shows them."""
    method: str = "mad"
    """What is trained on which subsets of streams."""
    recipe: str = "light"
    """``light`` (minutes, from a scripted expert) or ``paper`` (reinforcement learning)."""
    setting: str = "three"
    """Cameras and modalities."""
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
    """Of the learner; by default 1 for ``light``, whose recorder uses the other core, and one per
    core for ``paper``. Sums are split between threads, so another number is another run."""
    light: LightConfig = field(default_factory=LightConfig)
    paper: PaperConfig = field(default_factory=PaperConfig)

    def policy_spec(self) -> PolicySpec:
        """What the trained policy will say of itself."""
        streams = setting(self.setting).streams
        return PolicySpec(
            *(self.policy_name(), self.task, self.method, self.setting, self.recipe),
            streams=streams,
            trained_subsets=method(self.method).trained_subsets(streams),
            render_profile=self.render_profile,
        )

    def networks(self, env: EnvSpec, hidden_dim: int) -> NetworkConfig:
        """Sizes for ``env``, and which of its state numbers the heads read."""
        return NetworkConfig(
            *(env.state_dim, env.action_dim),
            hidden_dim=hidden_dim,
            state_columns=env.paper_state if self.state == "paper" else (),
        )

    def policy_name(self) -> str:
        """{suite}-{task}-{method}[-{setting}]-{recipe}."""
        parts = [self.task.replace("/", "-"), self.method]
        return "-".join([*parts, *([self.setting] if self.setting != "three" else []), self.recipe])


def train(config: TrainConfig, listener: Callable[[Event], None] | None = None) -> Path:
    """Trains and returns the policy's folder. Events go to ``listener``, by default one line each
    on standard error. Raises UserError for unknown names and for a folder that holds another run.
    """
    if config.recipe not in RECIPES:
        raise unknown("recipe", config.recipe, list(RECIPES))
    chosen = method(config.method)
    if config.recipe not in chosen.recipes:
        raise UserError(
            f"method {config.method!r} has the recipes {', '.join(chosen.recipes)}, "
            f"not {config.recipe!r}"
        )
    setting(config.setting)
    make_env(config.task, config.render_profile).close()
    everything = os.cpu_count() or 1
    torch.set_num_threads(config.threads or (1 if config.recipe == "light" else everything))
    out = config.out or Path("runs") / config.policy_name()
    described = replace(config, out=None, resume=False)
    folder = RunFolder(out, described, config.resume, listener or print_event)
    if config.recipe == "paper":
        train_paper(config, folder, command(config))
    else:
        _train_light(config, folder)
    return folder.path


def _train_light(config: TrainConfig, folder: RunFolder) -> None:
    env = make_env(config.task, config.render_profile)
    facts = env.spec
    env.close()
    spec = config.policy_spec()
    torch.manual_seed(config.seed)
    networks = config.networks(facts, config.light.hidden_dim)
    run = LightRun(config.light, spec, Agent(networks), facts.horizon, config.seed, folder.resume)
    state = folder.load_state()
    if state:
        run.restore(state)
        folder.truncate_curve("round", run.round)
    recorder = Recorder(config.task, config.render_profile, spec.streams, config.light.workers)
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
    training = {
        "how": "imitation of a scripted expert that labels the student's own states; "
        "not reinforcement learning from scratch",
        "command": command(config),
        "expert_demonstrations": config.light.demonstrations,
        "labelled_episodes": run.data.episodes,
        "environment_steps": len(run.data) * facts.action_repeat,
        "updates": run.updates,
        "critic_updates": updates,
        "batch_size": config.light.batch_size,
        "alpha": config.light.alpha,
        "seeds": f"network and data {config.seed}, episodes below 1000",
        "wall_time_s": round(run.seconds + time.monotonic() - began),
        "finished": final,
    }
    described = policy_config(
        facts,
        run.agent.config,
        name=config.policy_name(),
        method=config.method,
        setting=config.setting,
        recipe=config.recipe,
        streams=run.spec.streams,
        trained_subsets=run.spec.trained_subsets,
        training=training,
        reward_scale=REWARD_SCALE,
    )
    save_policy(folder.path, run.average, described)


def command(config: TrainConfig) -> str:
    """The line that trains this policy again."""
    default = TrainConfig()
    words = ["madviz", "train", "--task", config.task, "--method", config.method]
    words += ["--recipe", config.recipe]
    for name in ("setting", "seed", "state", "render_profile", "threads"):
        if getattr(config, name) != getattr(default, name):
            words += [f"--{name.replace('_', '-')}", str(getattr(config, name))]
    recipe, standard = getattr(config, config.recipe), getattr(default, config.recipe)
    for name, value in vars(recipe).items():
        if value != getattr(standard, name):
            words += [f"--{config.recipe}.{name.replace('_', '-')}", str(value)]
    return shlex.join([*words, "--out", f"checkpoints/{config.policy_name()}"])


def print_event(event: Event) -> None:
    """One line on standard error."""
    words = [f"{key} {value}" for key, value in event.items() if key != "kind"]
    print("  ".join([f"[{event['kind']}]", *words]), file=sys.stderr, flush=True)
