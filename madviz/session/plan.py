"""What a session does by itself: the commands of a kept episode, and a schedule of failures.

Both say what happens when a step arrives, before the next decision. A kept episode is lived again
once, and is over with its own episode; a schedule stays for all episodes until there is another.
Nothing is ticked off: what is due at a step is due again if an episode is forked before it.
"""

from __future__ import annotations

from madviz.observation.displacement import MoveCamera
from madviz.observation.schedule import Event, Schedule, reached
from madviz.session.commands import SetCamera, SetPolicy
from madviz.session.frame import untouched
from madviz.session.session_file import KeptEpisode, KeptPolicy
from madviz.session.simulation import Simulation


class Plan:
    """See the module. Belongs to the thread of its session."""

    def __init__(self, script: KeptEpisode | None = None) -> None:
        self.waiting = script
        """The episode to live again, until it begins."""
        self._script: KeptEpisode | None = None
        self.schedule: Schedule = ()

    def begin(self) -> None:
        """An episode begins: the one to live again, or an ordinary one."""
        self._script, self.waiting = self.waiting, None

    def due(self, simulation: Simulation) -> list[SetCamera | MoveCamera | SetPolicy]:
        """What to obey now that the simulation has come to a step, in order."""
        step, script = simulation.now.step, self._script
        scripted: list[SetCamera | MoveCamera | SetPolicy] = [
            SetPolicy(kept.command.name) if isinstance(kept.command, KeptPolicy) else kept.command
            for kept in (script.commands if script else ())
            if kept.step == step
        ]
        return [*scripted, *self._failures(self.schedule, step, simulation)]

    def reschedule(self, schedule: Schedule, simulation: Simulation | None) -> list[SetCamera]:
        """Takes another schedule; what to obey at once: cameras of the old one work again, and
        those of the new one that fail at this very step do. Raises UserError for an unknown camera.
        """
        old = self.schedule
        if simulation is None:
            self.schedule = schedule
            return []
        for event in schedule:
            simulation.env.spec.camera(event.camera)
        self.schedule, step = schedule, simulation.now.step
        back = tuple(Event(step, camera) for camera in dict.fromkeys(e.camera for e in old))
        return self._failures((*back, *schedule), step, simulation)

    def _failures(self, schedule: Schedule, step: int, simulation: Simulation) -> list[SetCamera]:
        """Commands that change something; of several for one camera the last."""
        intact, cameras = untouched(simulation.policy.spec), simulation.ablation.cameras
        names = [camera.name for camera in simulation.env.spec.cameras]
        states = {e.camera: e.state(intact) for e in reached(schedule, step, names)}
        return [
            SetCamera(name, state)
            for name, state in states.items()
            if cameras.get(name, intact) != state
        ]
