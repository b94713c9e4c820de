"""A second simulation in lock-step with the first: two policies or two camera settings, one seed.

Two success rates from different seeds differ by chance alone: at n = 20, by 0.3 one time in twenty.
The same seeds for both take the scenes out of the comparison, and then only the pairs that came out
differently count (McNemar):

    A   reset(2007)  step  step  ...  last step, SUCCESS  ┐
    B   reset(2007)  step  step  ...  last step, FAIL     ┘  one pair, for A

A pair counts if each side took all of its decisions under one condition.
"""

from __future__ import annotations

from collections.abc import Callable

from madviz.measure.statistics import Paired, pair
from madviz.observation.ablation import Ablation
from madviz.observation.displacement import MoveCamera
from madviz.policies.config import check_environment
from madviz.session.commands import SetCamera
from madviz.session.frame import Outcome, Pair, Side, carried, untouched
from madviz.session.journal import Journal
from madviz.session.simulation import Simulation
from madviz.session.waiting import PolicyWait
from madviz.types import CameraSpec, Environment, Policy

EnvFactory = Callable[[str, str, tuple[CameraSpec, ...]], Environment]
"""(task, render profile, cameras) -> environment, for example ``madviz.envs.registry.make_env``."""
MOST_PAIRS = 1000
"""Pairs that stay."""


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


def tally(pairs: tuple[Pair, ...], sides: tuple[Side, Side]) -> Paired:
    """The counts of all pairs between these two sides; a seed that came twice counts once."""
    ours = [one for one in pairs if one.sides == sides]
    return pair(
        {one.first.seed: one.first.success for one in ours},
        {one.second.seed: one.second.success for one in ours},
    )


class SecondSimulation:
    """B. Belongs to the thread that has A."""

    def __init__(
        self,
        make_env: EnvFactory,
        policy: Policy,
        ablation: Ablation,
        seed: int,
        wait: PolicyWait,
    ) -> None:
        """At the first step of ``seed``; ``wait`` as in ``Simulation``. Raises as
        ``open_simulation`` does."""
        spec = policy.spec
        env = make_env(spec.task, spec.render_profile, spec.cameras)
        self.simulation = open_simulation(env, policy, ablation, seed, wait=wait)
        self._whole = True

    def begin(self, seed: int, between: Callable[[], None]) -> None:
        """Both start at ``seed``; ``between`` as in ``Simulation.begin``, for A."""
        self.simulation.begin(seed, between)
        self._whole = True

    @property
    def goes_on(self) -> bool:
        """True while this episode has a decision left."""
        return self._whole and not self.simulation.ended

    def step(self, to: int) -> None:
        """One decision, if there is one left before the step ``to``."""
        if self.goes_on and self.simulation.now.step < to:
            self.simulation.step(lambda: None)

    def follow(self, first: Simulation) -> None:
        """Gives each camera the state and the place that it has in ``first``."""
        ours = self.simulation
        normal = untouched(ours.policy.spec)
        wanted = carried(first.ablation, first.policy.spec, ours.policy.spec)
        for name in (camera.name for camera in ours.env.spec.cameras):
            state = wanted.cameras.get(name, normal)
            if state != ours.ablation.cameras.get(name, normal):
                ours.set_camera(SetCamera(name, state))
            move = first.ablation.moves.get(name)
            if move != ours.ablation.moves.get(name):
                ours.move_camera(MoveCamera(name, move))

    def part(self) -> None:
        """A has gone back to an earlier step: this episode makes no pair."""
        self._whole = False

    def concluded(self, first: Outcome) -> Pair | None:
        """The pair of A's ended episode and this one, if each had one condition."""
        if not (self._whole and self.simulation.ended and self.simulation.outcomes):
            return None
        second = self.simulation.outcomes[-1]
        if first.seed != second.seed or first.condition is None or second.condition is None:
            return None
        return Pair(first, second)

    def close(self) -> None:
        self.simulation.close()
