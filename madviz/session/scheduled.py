"""Things that a session does by itself: commands of a saved episode, a schedule of failures.

Both say what happens when a step arrives, before the next decision. A saved episode is replayed
once, and is over when its own episode is; a schedule stays for all episodes until there is another.
What is due at a step is due again if an episode is forked before it.
"""

from __future__ import annotations

from madviz.observation.displacement import MoveCamera
from madviz.observation.schedule import Event, Schedule, reached
from madviz.policies.guarded import reference_to
from madviz.session.commands import SetCamera, SetPolicy
from madviz.session.frame import untouched
from madviz.session.session_file import SavedEpisode, SavedPolicy
from madviz.session.simulation import Simulation


class SessionPlan:
    """See the module. Belongs to the thread of its session."""

    def __init__(self, script: SavedEpisode | None = None) -> None:
        self.waiting = script
        """The episode to replay, until it begins."""
        self._script: SavedEpisode | None = None
        self.schedule: Schedule = ()

    def begin(self) -> None:
        """An episode begins: the one to replay, or an ordinary one."""
        self._script = self.waiting
        self.waiting = None

    def due(self, simulation: Simulation) -> list[SetCamera | MoveCamera | SetPolicy]:
        """The commands to carry out now that the simulation has come to a step, in order."""
        step = simulation.now.step
        script = self._script
        commands = [one.command for one in (script.commands if script else ()) if one.step == step]
        scripted: list[SetCamera | MoveCamera | SetPolicy] = [
            SetPolicy(reference_to(one.name)) if isinstance(one, SavedPolicy) else one
            for one in commands
        ]
        return [*scripted, *self._failures(self.schedule, step, simulation)]

    def reschedule(self, schedule: Schedule, simulation: Simulation | None) -> list[SetCamera]:
        """Takes another schedule. Returns the commands to carry out at once: cameras of the old one
        work again, and those of the new one that fail at this very step do. Raises UserError for an
        unknown camera.
        """
        old = self.schedule
        if simulation is None:
            self.schedule = schedule
            return []
        for event in schedule:
            simulation.env.spec.camera(event.camera)
        self.schedule = schedule
        step = simulation.now.step
        back = tuple(Event(step, camera) for camera in dict.fromkeys(e.camera for e in old))
        return self._failures((*back, *schedule), step, simulation)

    def _failures(self, schedule: Schedule, step: int, simulation: Simulation) -> list[SetCamera]:
        """Commands that change something; of several for one camera the last."""
        intact = untouched(simulation.policy.spec)
        cameras = simulation.ablation.cameras
        names = [camera.name for camera in simulation.env.spec.cameras]
        states = {e.camera: e.state(intact) for e in reached(schedule, step, names)}
        return [
            SetCamera(name, state)
            for name, state in states.items()
            if cameras.get(name, intact) != state
        ]
