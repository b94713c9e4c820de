"""Pages and sessions read all subsets in one pass, evaluations one: it makes no difference to
success, though sums of another order differ in their last bits."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from madviz.envs.registry import MANISKILL_TASKS, METAWORLD_TASKS, make_env
from madviz.measure.episodes import run_episode
from madviz.observation.ablation import Ablation
from madviz.policies.checkpoint import load_policy
from madviz.subsets import every_mask, row_of
from madviz.types import Array, Encoded, Policy, Readout

SEEDS = (5000, 5001)
TASKS = [f"metaworld/{task}" for task in METAWORLD_TASKS]
TASKS += [f"maniskill/{task}" for task in MANISKILL_TASKS]

CHAOTIC = {"maniskill/poke-cube"}
"""Here bodies touch hard and last bits grow: returns of one episode were 14.4 and 17.2 on one
machine, 16.2 and 7.7 on another, with success in all. The bound is not met; the test says so."""


class InOnePass:
    """``policy``, which reads every subset to answer for one."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self.spec = policy.spec
        self.encode = policy.encode
        self.supports = policy.supports

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        everything = every_mask(len(self.spec.streams))  # (N, V)
        found = self._policy.read(encoded, everything)
        rows = [row_of(mask) for mask in masks]
        return Readout(found.merged[rows], found.action[rows], found.q[rows])


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_success_is_the_same_in_one_pass_and_in_one_row(task: str) -> None:
    policy = load_policy(f"{task.replace('/', '-')}-mad-light")
    together = InOnePass(policy)
    assert isinstance(together, Policy)
    spec = policy.spec
    mask = np.ones(len(spec.streams), bool)
    returns = []
    with closing(make_env(spec.task, spec.render_profile, spec.cameras)) as env:
        for seed in SEEDS:
            alone = run_episode(policy, env, mask, Ablation(), seed)
            beside = run_episode(together, env, mask, Ablation(), seed)
            assert beside.success == alone.success
            if beside.total_reward != pytest.approx(alone.total_reward, rel=0.05):
                returns.append((seed, alone.total_reward, beside.total_reward))
    if returns and task in CHAOTIC:
        pytest.xfail(f"returns differ by more than 5 %: {returns}")
    assert returns == []
