"""The recipe ``paper-vectorised``: the paper's losses, over many environments that step together.

One environment and one update every second decision leave a machine with cores to spare waiting:
drawing three cameras takes longer than acting. Here L environments step in worker processes, and
the learner makes its updates *while* they step:

    act in L lanes -> workers step and draw ......................... -> L transitions
                         meanwhile updates on what was there before

How much is learned from a decision is an option: ``update_ratio``, 0.5 in the paper. With 8
environments that is 4 updates for a step of all; fewer make a run shorter and each decision count
for less. The curve reports both rates, ``env_steps_per_s`` and ``updates_per_s``.

On a CPU the order of everything is fixed, so a run is a function of its configuration and seed and
of the learner's threads, whatever the number of workers; a killed run goes on in mid-episode and
ends with the same weights. On a GPU it ends with similar ones: what is summed there in which order
is chosen by speed.

On a CUDA device (``--vectorised.device``) updates run there, in bfloat16 where it has it, each as
one CUDA graph (``agent/update_graph.py``), and the buffer's frames are in its memory
(``runs/buffer_device.py``).
"""

from __future__ import annotations

from contextlib import ExitStack, closing
from dataclasses import dataclass

from madviz.agent.update import named
from madviz.runs.lanes_run import LanesConfig, LanesRun
from madviz.runs.loop import train_on
from madviz.runs.run_folder import RunFolder
from madviz.runs.training_plan import TrainingPlan
from madviz.runs.vector_envs import Board, VectorEnvs
from madviz.training.reinforcement import ReinforcementConfig, ReinforcementRun


@dataclass(frozen=True)
class VectorisedConfig(LanesConfig, ReinforcementConfig):
    """The paper's numbers, and how many environments share the work."""

    ONLY_TIME = tuple(dict.fromkeys(LanesConfig.ONLY_TIME + ReinforcementConfig.ONLY_TIME))


class VectorisedRun(LanesRun, ReinforcementRun):
    """A run with the paper's losses whose decisions are made in all lanes at once."""

    SCHEDULE = "with the paper's losses over many environments"
    config: VectorisedConfig

    def learn(self) -> None:
        """As many updates as the decisions before this one ask for."""
        since, losses = self.step - self.config.exploration_steps, None
        while since > 0 and self.updates < int(since * self.config.update_ratio):
            losses = self.learner.step(self.buffer.sample(self.config.batch_size, self.rng))
            self.updates += 1
        if losses is not None:
            self.losses = named(losses)


def train_vectorised(plan: TrainingPlan, config: VectorisedConfig, folder: RunFolder) -> None:
    """Trains from the folder's last state on, if it has one; Ctrl-C saves after the decision at
    hand. Raises UserError for what the machine cannot do."""
    drawn_task, facts, lanes = plan.drawn_task, plan.env, config.environments
    with ExitStack() as resources:
        env = resources.enter_context(closing(drawn_task.build()))
        board = Board(lanes, drawn_task.streams, facts.state_dim, facts.action_dim)
        envs = VectorEnvs(drawn_task, board, lanes, config.processes())
        resources.callback(envs.close)
        train_on(VectorisedRun(plan, config, env, folder, envs))
