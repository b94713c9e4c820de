"""Begins a simulation, and leaves nothing open where it cannot begin."""

from __future__ import annotations

from madviz.observation.ablation import Ablation
from madviz.policies.config import check_environment
from madviz.session.journal import Journal
from madviz.session.simulation import Simulation
from madviz.session.waiting import PolicyWait
from madviz.types import Environment, Policy


def open_simulation(
    env: Environment,
    policy: Policy,
    ablation: Ablation,
    seed: int,
    journal: Journal | None = None,
    wait: PolicyWait | None = None,
) -> Simulation:
    """The simulation of ``policy`` in an ``env`` made for it, at the first step of ``seed``. Where
    they do not fit or it cannot begin, the error is raised and all is closed."""
    opened: Simulation | Environment = env
    try:
        check_environment(policy.spec, env.spec)
        opened = simulation = Simulation(env, policy, ablation, journal, wait)
        simulation.begin(seed)
        return simulation
    except BaseException:
        opened.close()
        raise
