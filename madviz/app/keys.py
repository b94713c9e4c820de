"""The keys of a page, for the browser, its command palette and the help."""

from __future__ import annotations

from collections.abc import Callable

from madviz.app.panel import Newest, Send
from madviz.observation.ablation import CameraState
from madviz.session.commands import (
    Pause,
    Play,
    Reset,
    SetCamera,
    SetSpeed,
    StepOnce,
)
from madviz.session.frame import Frame, untouched


class Keys:
    """A visitor's keys. They act on what the page shows last, ``newest``."""

    def __init__(self, send: Send | None, newest: Newest, frame: Frame) -> None:
        """``send`` is None for a visitor who only watches, and has none."""
        self._newest = newest
        self._send: Send = send or (lambda command: None)
        self._cameras = frame.world.env.cameras
        self._watches = send is None

    @property
    def table(self) -> list[tuple[str, str, Callable[[], None]]]:
        """Label, key, what it does."""
        if self._watches:
            return []
        send = self._send
        return [
            ("Play or pause", "space", self._play_or_pause),
            ("One step", "S", lambda: send(StepOnce())),
            ("Same seed again", "R", lambda: send(Reset())),
            ("Next seed", "N", lambda: send(Reset(next_seed=True))),
            ("Full speed", "F", lambda: send(SetSpeed(None))),
            ("Normal speed", "G", lambda: send(SetSpeed(10.0))),
            *(
                (
                    f"Drop {camera.label}, or take it back",
                    str(number),
                    lambda name=camera.name: self.toggle(name),
                )
                for number, camera in enumerate(self._cameras, 1)
            ),
        ]

    def toggle(self, camera: str) -> None:
        """Drops a camera, or takes it back in the modalities the policy knows."""
        frame = self._newest()
        if isinstance(frame, Frame):
            state = frame.camera(camera)
            back = untouched(frame.world.policy).input
            switch = back if state.input == "off" else "off"
            self._send(SetCamera(camera, CameraState(switch, state.occlusion)))

    def _play_or_pause(self) -> None:
        frame = self._newest()
        # With auto_next, the next episode begins by itself after an end.
        goes_on = isinstance(frame, Frame) and (
            frame.pace.phase == "playing" or (frame.pace.phase == "ended" and frame.pace.auto_next)
        )
        self._send(Pause() if goes_on else Play())
