"""The content of a session, without its pace: a simulation, its past, and a second one.

The session knows when something happens and who asked; the stage knows what happens. Everything
here is a function of the policy, the seeds and the order of calls, so a test needs no clock.

    session: inbox, pace, phase, errors  ──►  stage ─┬─ simulation   one policy, one environment
                                                     ├─ timeline     every step of it, and a branch
                                                     ├─ plan         what comes at a step by itself
                                                     ├─ journal      what it takes to replay it
                                                     └─ second       another simulation, lock-step
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

from madviz.analysis.foresight import Foresight, then
from madviz.analysis.saliency import LiveSaliency
from madviz.envs.registry import sees
from madviz.errors import UserError
from madviz.observation.ablation import Ablation
from madviz.observation.displacement import MoveCamera
from madviz.observation.schedule import Schedule
from madviz.policies.config import check_environment
from madviz.session.commands import SetCamera, SetPolicy
from madviz.session.comparison import (
    MOST_PAIRS,
    EnvFactory,
    SecondSimulation,
    open_simulation,
)
from madviz.session.frame import Frame, Pair, SessionPace, World, carried
from madviz.session.journal import Journal
from madviz.session.retrace import Retraces
from madviz.session.scheduled import SessionPlan
from madviz.session.session_file import SavedEpisode
from madviz.session.simulation import Simulation
from madviz.session.timeline import Timeline
from madviz.session.waiting import PolicyWait
from madviz.types import EnvSpec, Policy, PolicySpec


class Stage:
    """See the module. Belongs to the thread that opens it."""

    def __init__(
        self,
        make_env: EnvFactory,
        policy: Policy | str,
        load_policy: Callable[[str], Policy] | None,
        seed: int,
        script: SavedEpisode | None,
    ) -> None:
        """``policy``: one that is there, or a name that ``load_policy`` knows, for ``open``."""
        self._make_env = make_env
        self._load = load_policy
        self._references: dict[PolicySpec, str] = {}
        """The names by which policies were loaded, each by its first one."""
        self.policy = policy
        self.seed = seed
        """Who acts in which episode; before ``open``, and where one could not begin, who shall."""
        self.journal = Journal()
        self.wait = PolicyWait()
        """When a policy of either side is asked."""
        self._timeline = Timeline()
        self._plan = SessionPlan(script)
        self.simulation: Simulation | None = None
        """Always at a step; None where there is none, or none could begin."""
        self.saliency = LiveSaliency()
        self._foresight: Foresight | None = None
        self._second: SecondSimulation | None = None
        self._linked = True
        self._pairs: deque[Pair] = deque(maxlen=MOST_PAIRS)
        self._complete = True
        """True where B and the plan have come to A's step."""
        self._retraces = Retraces()

    @property
    def is_open(self) -> bool:
        return self.simulation is not None

    @property
    def ended(self) -> bool:
        return self.simulation is not None and self.simulation.ended

    @property
    def due(self) -> int | None:
        """The seed of the episode that is to begin: nothing is open, its first pictures did not
        come, or the one before has ended. None while an episode goes on."""
        live = self.simulation
        if live is None or any(side.missed for side in self._sides):
            return self.seed
        return self.seed + 1 if live.ended else None

    @property
    def has_an_ending(self) -> bool:
        """Whether a camera was changed in the episode that is over, or two policies compared."""
        return self._second is not None or bool(self._live.outcomes[-1].deeds)

    @property
    def _live(self) -> Simulation:
        if self.simulation is None:
            raise UserError("there is no simulation; press play to start one")
        return self.simulation

    def open(self, ablation: Ablation | None = None) -> None:
        """Builds the policy's environment, and begins, with its cameras as in ``ablation``, unless
        a saved episode or a schedule has another beginning. Where that fails, nothing is open."""
        self.shut()
        if isinstance(self.policy, str):
            self.policy = self._loaded(self.policy)
        script = self._plan.waiting
        world = script or self.policy.spec
        env = self._make_env(world.task, world.render_profile, world.cameras)
        begins = script.ablation if script else ablation or Ablation()
        begins = begins.of([camera.name for camera in env.spec.cameras])
        seed = script.seed if script else self.seed
        self.simulation = open_simulation(env, self.policy, begins, seed, self.journal, self.wait)
        self._begun(seed)

    def shut(self) -> None:
        """Closes the environment, and B's."""
        self._retraces.forget()
        self.compare(None)
        self._foresight = None
        if self.simulation is not None:
            self.simulation.close()
            self.simulation = None

    def begin(self, seed: int, between: Callable[[], None] = lambda: None) -> None:
        """Starts the episode of ``seed``; ``between`` as in ``Simulation.begin``. Where nothing is
        open, it is opened."""
        self.seed = seed
        live = self.simulation
        if live is None:
            self.open()
            return
        self._retraces.forget()
        self._timeline.show(None)  # What is touched meanwhile is touched now, not in the past.
        if self._second is not None:  # Before A, whose last step is there to be touched meanwhile.
            self._second.begin(seed, between)
        episode = live.episode
        try:
            live.begin(seed, between)
        finally:
            if live.episode > episode:  # Also where the policy gave no first answer.
                self._forget_episode()
        self._run_plan()

    def _begun(self, seed: int) -> None:
        """A stands at the first step of ``seed``, and so does B if there is one."""
        self.seed = seed
        self._forget_episode()
        self._run_plan()

    def _forget_episode(self) -> None:
        """Another one has begun."""
        self._timeline = Timeline()
        self.saliency.forget()
        if self._foresight is not None:  # It stays to be looked at.
            self._foresight = replace(self._foresight, closed=True)
        self._retraces.begin()
        self._complete = False
        self._plan.begin()

    def step(self, between: Callable[[], None]) -> None:
        """One decision, on both sides if there are two; ``between`` as in ``Simulation.step``.
        Where an error has cut a step short, the rest of it."""
        live = self._live
        b = self._second
        sides = [live, *([b.simulation] if b is not None and b.goes_on else [])]
        for side in sides:
            side.check()
        if self._complete:
            for side in sides:
                self._retraces.note(side)
            self._step_a(between)
        if b is not None:
            b.step(live.now.step)
        self._run_plan()
        if live.ended and b is not None:
            while b.goes_on:  # Where success ends an episode, A's may be the shorter one.
                if self._complete:
                    self._retraces.note(b.simulation)
                b.step(b.simulation.now.step + 1)
            pair = b.concluded(live.outcomes[-1])
            if pair is not None:
                self._pairs.append(pair)

    def _step_a(self, between: Callable[[], None]) -> None:
        live = self._live
        condition = str(live.condition)
        step = live.now.step
        try:
            live.step(between)
        finally:
            self._complete = live.now.step == step
        if self._foresight is not None:
            now = live.now
            self._foresight = then(
                self._foresight, live.policy, now.views, live.env.spec, now.time.reward, condition
            )

    def touch(self, command: SetCamera | MoveCamera, preview: bool = False) -> None:
        """Another state or place for a camera; in the past, another future begins with it."""
        if self._timeline.shown is not None:
            self.fork()
        if isinstance(command, MoveCamera):
            self._retraces.leave()  # The picture is drawn anew.
            self._live.move_camera(command)
        else:
            self._live.set_camera(command, preview)
        if not preview:  # In the middle of a step B waits for its end, which is where A's begins.
            self._sync_b()

    def swap(self, name: str) -> bool:
        """Another policy; in the same episode where it belongs to the same task and render profile,
        otherwise in a new environment. Returns whether that began the episode again. If it cannot
        be loaded, or gives no answer in the same episode, the old one stays."""
        policy = self._loaded(name)
        if self._timeline.shown is not None:
            self.fork()
        live = self.simulation
        if live is not None and self._lives_in(policy.spec, live.env.spec):
            check_environment(policy.spec, live.env.spec)
            live.swap(policy)
            self.policy = policy
            self.saliency.forget()
            self._foresight = None
            return False
        self.policy = policy
        self.open(carried(live.ablation, live.policy.spec, policy.spec) if live else None)
        return True

    @staticmethod
    def _lives_in(policy: PolicySpec, env: EnvSpec) -> bool:
        same = (policy.task, policy.render_profile) == (env.task, env.render_profile)
        return same and sees(env, policy.cameras)

    def explain(self, now: float, moving: bool, full_speed: bool) -> bool:
        """Finds the pixels that matter if somebody asked and it is time; whether it did."""
        live = self.simulation
        if live is None or self._timeline.shown is not None:
            return False
        return live.explain(self.saliency, now, moving, full_speed)

    def foresee(self, on: bool) -> None:
        """Imagines what follows the newest step, which is shown again; or forgets what was
        imagined. Raises UserError where the policy has no world model."""
        self._timeline.show(None)
        self._foresight = self._live.foresee() if on else None

    def read_more(self) -> bool:
        """Reads one more subset of the newest step, if that is the one that is shown and has one to
        read. Returns whether one was read."""
        live = self.simulation
        return live is not None and self._timeline.shown is None and live.read_more()

    @property
    def _sides(self) -> list[Simulation]:
        return [self._live, *([self._second.simulation] if self._second is not None else [])]

    @property
    def can_act(self) -> bool:
        """True if every policy can decide on the cameras that it has."""
        return all(side.can_act for side in self._sides)

    @property
    def retracing(self) -> bool:
        """True while a replay with all cameras is not done."""
        return self._retraces.going

    def retrace(self) -> bool:
        """One decision of the ended episode, played once more with all cameras, on each side where
        one was changed. Returns whether its paths have just come to be known."""
        return self._retraces.advance(self._sides)

    def show_step(self, step: int | None) -> None:
        """Shows an earlier step from now on; None: the newest one."""
        if step is not None:
            self._live.snapshot()  # Where nothing is open there is no past either.
        self._timeline.show(step)

    def fork(self) -> None:
        """Stands at the earlier step that is shown; whatever is done next begins another future."""
        if self._timeline.shown is None:
            raise UserError("expected an earlier step to fork from; drag the timeline back first")
        live = self._live
        self._retraces.forget()
        to = self._timeline.fork()
        self._retraces.went_back(live, len(to.actions))
        live.return_to(to)
        self._foresight = None
        self._complete = True
        self.policy = live.policy
        self.seed = live.seed
        if self._second is not None:
            self._second.part()

    def compare(self, name: str | None, ablation: Ablation | None = None) -> None:
        """Starts B, and the episode again for both; None ends B. They are linked if their cameras
        begin alike. Raises UserError if B's policy belongs to another task: there would be nothing
        to compare. Where the new B cannot begin, the old one and its pairs stay."""
        self._retraces.forget()
        second = None if name is None else self._open_second(name, ablation or Ablation())
        if self._second is not None:
            self._second.close()
        self._second = second
        self._pairs.clear()
        if second is not None:
            live = self._live
            b = second.simulation
            self._linked = b.ablation == carried(live.ablation, live.policy.spec, b.policy.spec)
            live.begin(self.seed)
            self._begun(self.seed)

    def _open_second(self, name: str, ablation: Ablation) -> SecondSimulation:
        """Another B, at the first step of A's seed. Raises UserError as ``compare`` does."""
        live = self._live
        if live.env.spec.recorded:
            raise UserError(
                f"expected a task in a simulator to compare two policies in, found "
                f"{live.env.spec.task}: what was recorded goes on whatever they do; explore one "
                "after the other"
            )
        policy = self._loaded(name)
        if policy.spec.task != live.env.spec.task:
            raise UserError(
                f"expected a policy for {live.env.spec.task} on B's side, found {name!r} for "
                f"{policy.spec.task}; choose one of the same task"
            )
        begins = carried(ablation, live.policy.spec, policy.spec)
        return SecondSimulation(self._make_env, policy, begins, self.seed, self.wait)

    def link(self, on: bool) -> None:
        """Whether what is done to A's cameras is done to B's, too."""
        self._linked = on
        self._sync_b()

    def _sync_b(self) -> None:
        """Does to B's cameras what was done to A's, if they are linked."""
        if self._second is not None and self._linked:
            self._second.follow(self._live)

    def reschedule(self, events: Schedule) -> None:
        """Another schedule of failures; an empty one ends them."""
        for command in self._plan.reschedule(events, self.simulation):
            self._live.set_camera(command)
        self._sync_b()

    def frame(self, keep: bool, pace: SessionPace) -> Frame | None:
        """All of it at this time step, with what the session says of its pace; None where nothing
        is to be seen. ``keep``: not for a preview, which leaves the step it shows as it was."""
        live = self.simulation
        if live is None:
            return None
        paths = self._retraces.paths
        b = self._second
        frame = Frame(
            self._world(live),
            pace,
            second=Frame(self._world(b.simulation), pace, paths=paths[1]) if b else None,
            linked=self._linked,
            pairs=tuple(self._pairs),
            schedule=self._plan.schedule,
            saliency=self.saliency.maps,
            explained=self.saliency.target,
            foresight=self._foresight,
            paths=paths[0],
        )
        frame = self._timeline.live(frame, live.snapshot(), keep)
        return frame if self._timeline.shown is None else self._timeline.again(frame)

    def _loaded(self, name: str) -> Policy:
        if self._load is None:
            raise UserError("this session has no other policies to load")
        policy = self._load(name)
        self._references.setdefault(policy.spec, name)
        return policy

    def _world(self, side: Simulation) -> World:
        world = side.world()
        policy = world.policy
        return replace(world, reference=self._references.get(policy, policy.name))

    def _run_plan(self) -> None:
        """Carries out what comes by itself at the step that has arrived."""
        for command in self._plan.due(self._live):
            if isinstance(command, SetPolicy):
                self.swap(command.name)
            elif isinstance(command, MoveCamera):
                self._live.move_camera(command)
            else:
                self._live.set_camera(command)
        self._sync_b()
        self._complete = True
