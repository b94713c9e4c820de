"""One policy in one environment, with cameras that can fail at any moment. No threads, no clock.

``Simulation`` is the deterministic half of a live session: what an episode does depends on its
seed and on which commands came at which step, on nothing else. The features of the newest frame
stay in memory, with what *every* subset would do with them, so that switching a camera off reads a
table and a new occlusion costs one encoding; neither waits for a picture to be drawn.

A camera touched while step t+1 is being drawn counts as touched when that step has arrived. What is
shown in between is a preview of step t under the new condition, and leaves no trace, however many
of them there are: the picture of step t stays as it arrived, under ``_settled``. The journal counts
steps the same way, so that an episode can be saved and replayed to the bit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from madviz.analysis.foresight import Foresight, can_foresee, foresee
from madviz.analysis.imagination import imagined
from madviz.analysis.probes import Probe
from madviz.analysis.saliency import LiveSaliency
from madviz.errors import CannotAct, UserError
from madviz.observation.ablation import Ablation
from madviz.observation.condition import Condition
from madviz.observation.displacement import MoveCamera
from madviz.session.commands import SetCamera
from madviz.session.episode_record import EpisodeRecord
from madviz.session.frame import Change, Outcome, Reading, World, carried, untouched
from madviz.session.journal import Journal
from madviz.session.policy_input import PolicyInput
from madviz.session.session_file import SavedPolicy
from madviz.session.snapshot import Snapshot, StepData
from madviz.session.waiting import PolicyWait
from madviz.types import Array, Environment, Policy


class Simulation:
    """See the module. Belongs to the thread that created ``env``."""

    def __init__(
        self,
        env: Environment,
        policy: Policy,
        ablation: Ablation,
        journal: Journal | None = None,
        wait: PolicyWait | None = None,
    ) -> None:
        """``wait`` knows when ``policy`` is asked."""
        self.env = env
        self.policy = policy
        self.ablation = ablation
        self._settled = ablation
        self.journal = journal or Journal()
        self.outcomes: deque[Outcome] = deque(maxlen=20)
        self.episode = 0
        self.seed = 0
        self.change: Change | None = None
        self._recent: deque[StepData] = deque(maxlen=_kept(policy))
        """The newest frames of the stack, raw: what a policy swapped in needs as its past."""
        self.record = EpisodeRecord()
        self._actions: list[Array] = []
        self.missed = False
        """True where an error has cut in while an episode was to begin, or to go back to a step."""
        self._wait = wait or PolicyWait()
        self.input = PolicyInput(policy, env.spec, self._wait)
        for camera in env.spec.cameras:
            if camera.name in ablation.moves:
                self._place(camera.name)

    @property
    def now(self) -> StepData:
        return self._recent[-1]

    @property
    def ended(self) -> bool:
        return self.now.time.last

    @property
    def arrived(self) -> dict[str, Array]:
        """(H, W, C) uint8 by stream, what reached the policy last."""
        return self.input.stack.newest

    @property
    def probe(self) -> Probe:
        """The actions of every subset of this step."""
        return self.input.probe

    @property
    def condition(self) -> Condition:
        return Condition.of(self.ablation, self.policy.spec.streams)

    def world(self) -> World:
        """The part of a ``Frame`` that describes the simulation at this time step."""
        now = self.now
        return World(
            env=self.env.spec,
            policy=self.policy.spec,
            episode=self.episode,
            seed=self.seed,
            step=now.step,
            ablation=self.ablation,
            views=now.views,
            arrived=dict(self.arrived),
            poses=now.poses,
            bodies=now.bodies,
            body_poses=now.body_poses,
            hand=now.hand,
            probe=self.probe,
            planned=self.input.playing.planned,
            reward=now.time.reward,
            total_reward=self.record.total_reward,
            success=now.time.success,
            success_any=self.record.success_any,
            last=now.time.last,
            change=self.change,
            outcomes=tuple(self.outcomes),
            imagined=imagined(
                self.policy,
                self.input.used,
                self._present,
                self.input.acts_on(self._present),
                now.views,
                self.env.spec,
            ),
            foresees=can_foresee(self.policy),
            guard=self.input.guard,
            recorded=now.recorded,
        )

    def explain(self, live: LiveSaliency, now: float, moving: bool, full_speed: bool) -> bool:
        """Finds the pixels that matter if a new map is due; whether it was."""
        mask = self.input.acts_on(self._present)
        if not live.due(self.probe, mask, now, moving, full_speed):
            return False
        with self._wait:
            views = self.input.views  # (V, C, H, W)
            live.update(self.policy, views, self.now.time.state, mask, self.probe, now)
        return True

    def foresee(self) -> Foresight:
        """The policy's imagination of the next decisions. Raises UserError where it cannot."""
        present = self.input.acts_on(self._present)
        here = (present, self.now.step, str(self.condition))
        return foresee(self.policy, self.input.used, *here)

    def begin(self, seed: int, between: Callable[[], None] = lambda: None) -> None:
        """Starts the episode of ``seed``; camera settings stay. ``between`` is called as in
        ``step``, and meets the last step of the episode before."""
        # Before the very first episode there is no step that commands could touch.
        pause = between if self._recent else lambda: None
        self.missed = True
        first = StepData.first(self.env, seed, pause)
        # The new episode begins here: until now a command met the old one.
        self.episode += 1
        self.seed = seed
        self.input.begin(seed)
        self.record = EpisodeRecord(success_any=first.time.success)
        self.change = None
        self._recent.clear()
        self._actions = []
        self.journal.begin(self.policy.spec, self.env.spec, seed, self.ablation)
        self._push(first)
        self.missed = False
        self._read()

    @property
    def can_act(self) -> bool:
        """True if the policy can decide on the cameras that are present."""
        return bool(self.probe.supported[self.probe.row(self._present)])

    def check(self) -> None:
        """Asks the policy once more where it gave no answer on this step. Raises UserError if no
        decision can be taken here, CannotAct where it is for want of a camera."""
        if self.missed or len(self._actions) != self.now.step:
            raise UserError(
                f"expected {self.env.spec.task} at step {self.now.step} of seed {self.seed}, found "
                "it elsewhere: an error cut in; start the seed again"
            )
        if self.input.unread:
            self._read()
        if not self.can_act:
            raise CannotAct(
                f"{self.policy.spec.name} cannot act on {self.condition.subset!r}; "
                "switch another camera on"
            )

    def step(self, between: Callable[[], None]) -> None:
        """Takes one decision. ``between`` is called after every camera that is drawn, and may call
        ``set_camera``. Raises UserError as ``check`` does."""
        self.check()
        shown = self._reading()[1]  # (A,)
        action = self.input.playing.decide(self.input.encoded, self._present, shown)
        time_step = self.env.step(action)
        self._actions.append(action)
        self.journal.decided(self.now.step, action, time_step)
        self.record.note(self.policy.spec, self.condition, self.ablation)
        self.record.arrived(time_step)
        self._push(StepData.drawn(self.env, time_step, self.now.step + 1, between))
        if time_step.last:
            ended = (self.seed, time_step.success, self.env.spec.cameras)
            self.outcomes.append(self.record.outcome(self.policy.spec, *ended))
        self._read()

    def close(self) -> None:
        """Frees the environment, and what the policy holds for this episode."""
        self.leave()
        self.env.close()

    def leave(self) -> None:
        """Frees what the policy holds for this episode."""
        self.input.playing.close()

    def read_more(self) -> bool:
        """Reads one more subset of this step, where each costs a pass; whether there was one."""
        return self.input.read_more()

    def set_camera(self, command: SetCamera, preview: bool = False) -> None:
        """Another state for one camera, seen at once. Raises UserError for an unknown camera."""
        with self._all_or_nothing(command.camera) as (before, reading):
            self.ablation = before.replace(command.camera, command.state)
            if self.ablation.occlusions() != before.occlusions():
                self.input.stack.replace_last(self.ablation)
                self._read()
                if preview:
                    self.input.stack.replace_last(self._settled)
            elif self.input.guard is not None:  # It judges the cameras that are present.
                self.input.judge(self._present)
            self._changed(command.camera, before, reading)
        if not preview:
            self._settled = self.ablation
        self.journal.note(self.now.step + preview, command)

    def move_camera(self, command: MoveCamera) -> None:
        """One camera elsewhere, seen at once: the newest picture is drawn anew, earlier ones of the
        stack stay. Raises UserError for an unknown camera. Not in the middle of a step."""
        name = command.camera
        with self._all_or_nothing(name) as (before, reading):
            self.ablation = before.move(name, command.move)
            if self.ablation.moves == before.moves:
                return
            self._place(name)
            self._recent[-1] = self.now.redrawn(self.env, name)
            self.input.stack.replace_view(name, self.now.views[name])
            self.input.stack.replace_last(self.ablation)
            self._read()
            to = self.ablation.moves.get(name)
            moved = f"moved: {to.words()}" if to else "is back in its place"
            self._changed(name, before, reading, moved)
        self._settled = self.ablation
        self.journal.note(self.now.step, command)

    @contextmanager
    def _all_or_nothing(self, camera: str) -> Iterator[tuple[Ablation, Reading]]:
        """All cameras, and the reading, as they are; ``camera``, and what the policy got from it,
        are put back if anything raises."""
        self.env.spec.camera(camera)
        before = self.ablation
        got = self.input.state()
        now = self.now
        reading = self._reading()
        try:
            yield before, reading
        except BaseException:
            moved = self.ablation.moves != before.moves
            self.ablation = before
            self.input.restore(got)
            self._recent[-1] = now
            if moved:
                self._place(camera)
            raise

    def _changed(self, camera: str, before: Ablation, reading: Reading, moved: str = "") -> None:
        """Notes the effect of a command: ``before`` and ``reading`` were those without it."""
        normal = untouched(self.policy.spec)
        states = [at.cameras.get(camera, normal) for at in (before, self.ablation)]
        if moved or states[0] != states[1]:
            self.change = Change.between(camera, states, (reading, self._reading()), moved)

    def swap(self, policy: Policy) -> None:
        """Another policy in the same episode. It gets the pictures that have arrived, or, where it
        sees others, the newest frames under the present settings. If it gives no answer, the old
        one stays."""
        old = self.policy.spec
        ablation = carried(self.ablation, old, policy.spec)
        sees, saw = ((one.streams, one.frame_stack, one.image_size) for one in (policy.spec, old))
        past = [] if sees == saw else list(self._recent)[-policy.spec.frame_stack - 1 :]
        fresh = PolicyInput(policy, self.env.spec, self._wait)
        try:
            fresh.begin(self.seed)
            if not past:  # A frozen or late camera goes on with the picture that it has.
                fresh.stack.restore(self.input.stack.snapshot())
            for data in past:
                fresh.push(data, ablation, self.seed)
            fresh.read(self.now.time.state, ablation.mask(policy.spec.streams))
        except BaseException:
            fresh.playing.close()
            raise
        self._adopt(policy, fresh)
        self.ablation = ablation
        self._settled = ablation
        self.change = None
        self.record.swapped(policy)
        self.journal.note(self.now.step, SavedPolicy.of(policy.spec))

    def snapshot(self) -> Snapshot:
        """The present step, for ``return_to``."""
        return Snapshot(
            actions=tuple(self._actions),
            recent=tuple(self._recent),
            policy=self.policy,
            looks=tuple(self.input.playing.looks),
            input=self.input.state(),
            ablation=self.ablation,
            record=self.record.copy(),
            mark=self.journal.mark(),
        )

    def return_to(self, saved: Snapshot) -> None:
        """Stands at an earlier step of this episode again. An episode is its seed and its actions,
        so the simulator takes those once more, without drawing anything. Raises UserError if it
        does not come to the same state."""
        self.missed = True
        strayed = {*self.ablation.moves, *saved.ablation.moves}
        self.ablation = saved.ablation
        for camera in strayed:
            self._place(camera)
        time_step = self.env.reset(self.seed)
        for action in saved.actions:
            time_step = self.env.step(action)
        if not np.array_equal(time_step.state, saved.recent[-1].time.state):
            self.journal.spoil()
            raise UserError(
                f"expected {self.env.spec.task} to repeat seed {self.seed} to the bit, found "
                "another state: its reset or step depends on something else; start the seed again"
            )
        self._adopt(saved.policy, PolicyInput(saved.policy, self.env.spec, self._wait))
        self._recent = deque(saved.recent, maxlen=self._recent.maxlen)
        self.input.restore(saved.input)
        self._actions = list(saved.actions)
        if not self.input.playing.again(self.policy, self.seed, saved.looks, saved.actions):
            self.journal.spoil()
            raise UserError(
                f"expected {self.policy.spec.name} to decide the same from the same pictures, "
                "found another action: its noise is not fixed by a seed; start the seed again"
            )
        self.input.look_again(self._present)
        self.record = saved.record.copy()
        self._settled = saved.ablation
        self.change = None
        self.journal.back(saved.mark)
        self.missed = False

    def _adopt(self, policy: Policy, fresh: PolicyInput) -> None:
        """``policy`` acts from now on, with what it gets in ``fresh``."""
        self.leave()
        self.policy = policy
        self.input = fresh
        self._recent = deque(self._recent, maxlen=_kept(policy))

    def _place(self, camera: str) -> None:
        """Puts a camera where the ablation has it."""
        spec = self.env.spec.camera(camera)
        to = self.ablation.moves.get(camera)
        self.env.move_camera(camera, to.placed(spec) if to else None)

    def _push(self, data: StepData) -> None:
        self.input.push(data, self.ablation, self.seed)
        self._settled = self.ablation
        self._recent.append(data)

    def _read(self) -> None:
        self.input.read(self.now.time.state, self._present)

    @property
    def _present(self) -> Array:
        """(V,) bool: the streams that nobody has switched off."""
        return self.ablation.mask(self.policy.spec.streams)

    def _reading(self) -> Reading:
        """The present condition, and the action and Q under it."""
        return self.condition, *self.input.action(self._present)


def _kept(policy: Policy) -> int:
    """Steps that stay: what ``policy``, or one swapped in, needs as its past."""
    return max(policy.spec.frame_stack, 3) + 1
