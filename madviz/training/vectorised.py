"""The recipe ``paper-vectorised``: the paper's losses, over many environments that step together
(``runs/lanes_run.py``).

One environment and one update every second decision leave a machine with cores to spare waiting:
drawing three cameras takes longer than acting. Here L environments step in worker processes, and
the learner makes its updates *while* they step.

How much is learned from a decision is an option: ``update_ratio``, 0.5 in the paper. With 8
environments that is 4 updates for a step of all; fewer make a run shorter and each decision count
for less. The curve reports both rates, ``env_steps_per_s`` and ``updates_per_s``.

A killed run goes on in mid-episode and ends, on a CPU, with the same weights; on a GPU with similar
ones: what is summed there in which order is chosen by speed.

On a CUDA device (``--vectorised.device``) updates run there, in bfloat16 where it has it, each as
one CUDA graph (``agent/update_graph.py``), and the buffer's frames are in its memory
(``runs/buffer_device.py``).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from madviz.agent.update import Learner, named
from madviz.runs.lanes_run import LanesConfig, lanes_of, train_in_lanes
from madviz.runs.reward_run import RewardRun
from madviz.runs.run_folder import RunFolder
from madviz.runs.training_plan import TrainingPlan
from madviz.training.paper import ReinforcementConfig, act, evaluated, new_run

HOW = "reinforcement learning from scratch, with the paper's losses over many environments"


@dataclass(frozen=True)
class VectorisedConfig(LanesConfig, ReinforcementConfig):
    """The paper's numbers, and how many environments share the work."""

    ONLY_TIME = tuple(dict.fromkeys(LanesConfig.ONLY_TIME + ReinforcementConfig.ONLY_TIME))


def train_vectorised(plan: TrainingPlan, config: VectorisedConfig, folder: RunFolder) -> None:
    """Trains from the folder's last state on, if it has one; Ctrl-C saves after the decision at
    hand. Raises UserError for what the machine cannot do."""
    with lanes_of(plan, config) as envs:
        run = new_run(plan, config, folder, envs.lanes)
        train_in_lanes(
            run,
            envs,
            act=partial(act, run),
            learn=partial(learn, run),
            policy=partial(evaluated, run),
            record=partial(run.record, HOW),
        )


def learn(run: RewardRun[Learner, VectorisedConfig]) -> None:
    """As many updates as the decisions before this one ask for."""
    since = run.step - run.config.exploration_steps
    losses = None
    while since > 0 and run.updates < int(since * run.config.update_ratio):
        losses = run.learner.step(run.buffer.sample(run.config.batch_size, run.rng))
        run.updates += 1
    if losses is not None:
        run.losses = named(losses)  # Waits for a GPU once, not after every update.
