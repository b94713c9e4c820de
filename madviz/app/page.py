"""One visitor's page: panels around the scene, and the thread that keeps them up to date.

Frames come from the session's thread into a slot for one; the page's thread takes the newest, lets
every panel compute, and assigns all changes in one ``atomic`` block. A slow page skips frames and
never slows the simulator. What a visitor looks at while switching a camera goes first and at every
frame: pictures, action, state. Tables and textures follow at a few a second.

The first frame after a touch is drawn by the session's own thread, which has it already: every
change of threads would be a wait for a core, and at full speed all cores are taken.
"""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

import viser

from madviz.ablations import CameraState
from madviz.app.arrows import ArrowsPanel
from madviz.app.cameras import CamerasPanel
from madviz.app.draw import DRAW_SCRIPT
from madviz.app.failures import FailuresPanel
from madviz.app.features import FeaturesPanel
from madviz.app.keep import KeepPanel
from madviz.app.move import MovePanel
from madviz.app.pace import PACE_SCRIPT
from madviz.app.panel import Panel, apply
from madviz.app.policy import PolicyChoice, PolicyPanel
from madviz.app.projection import MapPanel
from madviz.app.saliency import SaliencyPanel
from madviz.app.scene import ScenePanel, extent
from madviz.app.screen import SCREEN_SCRIPT
from madviz.app.subsets import SubsetsPanel
from madviz.app.success import Rates, SuccessPanel, WordsPanel
from madviz.app.timeline import TimelinePanel
from madviz.app.toolkit import (
    LEFT_WIDTH,
    LEFT_WIDTH_WIDE,
    STYLE,
    commands,
    dock,
    run_layout,
    run_script,
    window_is_wide,
)
from madviz.app.tour import Tour
from madviz.app.training import TrainingPanel
from madviz.app.versus import VersusPanel
from madviz.app.worth import WorthPanel
from madviz.recipes.training_job import TrainingJob
from madviz.saliency import Target
from madviz.session.commands import (
    Command,
    Pause,
    Play,
    Reset,
    SetCamera,
    SetSaliency,
    SetSpeed,
    StepOnce,
)
from madviz.session.frame import Change, Failure, Frame, untouched
from madviz.session.session import Session

FASTEST = 1 / 40
"""Seconds between two frames that are shown: more would be wasted on a browser."""
AFTER = 0.1
"""Seconds after which tables, curves and the scene follow when something was touched; at full speed
they keep to their own times, or they would be in the way of the next touch."""

log = logging.getLogger(__name__)


@dataclass
class Shown:
    """A panel, and how often it is brought up to date while nothing is touched."""

    panel: Panel
    period: float
    """Seconds."""
    done: float = -1e9
    number: int = 0
    """The last frame it showed."""

    def patience(self, frame: Frame) -> float:
        """Seconds between two updates. At full speed, what is not watched all the time waits twice
        as long: the machine is wanted for the simulator and the pictures."""
        return self.period * (2 if frame.speed is None and self.period > FASTEST else 1)

    def due(self, frame: Frame) -> float:
        """When it is brought up to date next."""
        return self.done + self.patience(frame)


class Page:
    """See the module. ``readonly`` pages watch somebody else's session."""

    def __init__(
        self,
        client: viser.ClientHandle,
        session: Session,
        choices: Sequence[PolicyChoice],
        rates: Rates,
        job: TrainingJob,
        notice: str = "",
        readonly: bool = False,
    ) -> None:
        self.client, self.session = client, session
        self._choices, self._rates, self._job = choices, rates, job
        self._notice, self._readonly = notice, readonly
        self._wide = window_is_wide(client)
        self._waiting: viser.GuiHtmlHandle | None = None
        self._extras: list = []
        self._shown: list[Shown] = []
        self._wanted: object = None
        self._built: object = None
        """The task and cameras whose panels were to be built, and were."""
        self._reported = ""
        self._curves: FeaturesPanel | None = None
        self._touched: object = None
        self._expected: Change | None = None
        self._drawing = threading.Lock()
        self._hurried = threading.Event()
        """Somebody has touched a camera and waits for ``_drawing``."""
        self._newest: Frame | Failure | None = None
        self._wake, self._closing = threading.Event(), threading.Event()
        self._beginning = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="madviz-page", daemon=True)

    def start(self) -> None:
        """Begins to draw; a page that was closed before, by whoever was quicker, never does."""
        with self._beginning:
            if self._closing.is_set():
                return
            self._waiting = self.client.gui.add_html(waiting_html("The simulator is starting."))
            self._thread.start()
            self.session.subscribe(self.show)
            self._rates.subscribe(self.poke)

    def show(self, frame: Frame | Failure) -> None:
        """Takes a frame, from any thread; an older one that was not shown yet is forgotten. If it
        is the first one since its visitor touched a camera, it is on its way before this returns.
        """
        self._newest = frame
        change = frame.change if isinstance(frame, Frame) else None
        fresh = change is not None and change is not self._expected and not self._readonly
        self._expected = change
        if fresh and self._built is not None:
            self._hurried.set()
            self._draw()
            self._hurried.clear()
        self._wake.set()

    def poke(self) -> None:
        """Shows the newest frame again: something beside it has changed."""
        for shown in self._shown:
            shown.number = 0
        self._wake.set()

    def close(self) -> None:
        """Lets go of session and thread; the browser may be gone already."""
        with self._beginning:
            self._closing.set()
        self.session.unsubscribe(self.show)
        self._rates.unsubscribe(self.poke)
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._rates.forget(self.client.client_id)

    def clear(self) -> None:
        """Takes everything off the page, after ``close``."""
        self._strip()
        if self._waiting is not None:
            self._waiting.remove()

    def _strip(self) -> None:
        """Takes panels and scene off the page."""
        for shown in self._shown:
            shown.panel.remove()
        for handle in self._extras:
            handle.remove()
        self._shown, self._extras = [], []

    # The page's own thread.

    def _run(self) -> None:
        pause: float | None = None
        while not self._closing.is_set():
            self._wake.wait(pause)
            self._wake.clear()
            if not self._closing.is_set():
                pause = self._draw()

    def _draw(self) -> float | None:
        """Pushes the newest frame, in whatever thread. Returns in how many seconds a panel that was
        left out is due."""
        with self._drawing:
            try:
                pause = self._push(self._newest, time.monotonic()) if self._newest else None
                self._forgive()
                return pause
            except Exception:
                # A panel that fails must not take the page down; the next frame may be fine.
                self._report(traceback.format_exc())
                return None

    def _forgive(self) -> None:
        """Takes back what ``_report`` said: a later frame was shown, nothing is broken."""
        if (
            self._built is not None
            and self._reported
            and self._waiting is not None
            and isinstance(self._newest, Frame)
        ):
            self._reported = ""
            self._waiting.content = waiting_html(self._notice) if self._notice else ""

    def _report(self, error: str) -> None:
        """Says once, in the log and on the page, that a frame could not be shown."""
        if error != self._reported and self._waiting is not None:
            self._reported = error
            log.error("a frame could not be shown\n%s", error)
            self._waiting.content = waiting_html("A frame could not be shown.", error)

    def _push(self, frame: Frame | Failure, now: float) -> float | None:
        """Shows ``frame``. Returns in how many seconds a panel that was left out is due."""
        assert self._waiting is not None
        if isinstance(frame, Failure):
            self._waiting.content = waiting_html("The simulator could not start.", frame.error)
            return None
        wanted = (frame.env.task, frame.env.cameras)
        if wanted != self._wanted:  # Once: what cannot be built now cannot at the next frame.
            self._wanted, self._built = wanted, None
            self._build(frame)
            self._built = wanted
        if self._built is None:
            return None
        assert self._curves is not None
        if not frame.past:
            self._curves.note(frame)
        urgent = self._touched != (frame.change, frame.policy, frame.phase, frame.error)
        self._touched = (frame.change, frame.policy, frame.phase, frame.error)
        due = [s for s in self._shown if s.number != frame.number]
        if urgent:  # What somebody waits for goes ahead of the rest.
            for shown in self._shown:
                rest = now + AFTER - shown.patience(frame)
                shown.done = rest if frame.speed is not None else max(shown.done, rest)
        ready = [s for s in due if (urgent and s.period <= FASTEST) or now >= s.due(frame)]
        # All in one message, because each one costs the browser a frame.
        changes = []
        for shown in ready:
            if self._hurried.is_set() and not urgent:
                break  # A table is not worth the wait of somebody who has just touched a camera.
            changes += shown.panel.update(frame)
            settled = not getattr(shown.panel, "unsettled", False)
            shown.done, shown.number = now, frame.number if settled else 0
        with self.client.atomic():
            apply(changes)
        self.client.flush()
        later = [s.due(frame) - now for s in due if s.number != frame.number]
        return max(0.01, min(later)) if later else None

    def _build(self, frame: Frame) -> None:
        self._strip()
        client, gui = self.client, self.client.gui
        send = None if self._readonly else self.session.send
        visitor = None if self._readonly else client.client_id
        assert self._waiting is not None
        self._waiting.content = waiting_html(self._notice) if self._notice else ""
        run_layout(client)
        run_script(client, SCREEN_SCRIPT)
        run_script(client, DRAW_SCRIPT)
        run_script(client, PACE_SCRIPT)
        with client.atomic():
            tour = Tour(client, send, lambda: self._newest, self._choices, self._keys(frame))
            policy = PolicyPanel(gui, send, frame, self._choices)
            success = SuccessPanel(gui, frame, self._rates, visitor)
            dockable = dock(client, self._wide)
            with dockable.add_tab("Cameras", viser.Icon.CAMERA):
                width = (LEFT_WIDTH_WIDE if self._wide else LEFT_WIDTH) - 18
                cameras = CamerasPanel(gui, send, frame, width)
                words = WordsPanel(gui, frame, self._rates)
                tabs = gui.add_tab_group()
            tabbed = self._build_tabs(tabs, send, frame)
            self._extras = [dockable, tour, *commands(client, self._shortcuts(frame))]
        self._shown = [
            *(Shown(cameras, FASTEST), Shown(policy, FASTEST), Shown(words, FASTEST)),
            *(*tabbed, Shown(success, 0.5)),
            Shown(ScenePanel(client, frame, None if self._readonly else self._toggle), 0.05),
            Shown(ArrowsPanel(client, frame, extent(frame)), 0.25),
        ]

    def _build_tabs(
        self, tabs: viser.GuiTabGroupHandle, send: Callable[[Command], None] | None, frame: Frame
    ) -> list[Shown]:
        """What stands under the cameras, a tab each. Names are short: ten fit into one row."""
        gui, wide = self.client.gui, self._wide
        explain = self._explain if send else None
        table: list[tuple[str, list[tuple[Callable[[], Panel], float]]]] = [
            ("Features", [(lambda: FeaturesPanel(gui, frame, 230 if wide else 150), 0.25)]),
            ("Subsets", [(lambda: SubsetsPanel(gui, frame), 0.5)]),
            ("Worth", [(lambda: WorthPanel(gui, frame, self._rates), 0.5)]),
            (
                "Inside",
                [
                    (lambda: SaliencyPanel(gui, explain, frame), 0.25),
                    (lambda: MapPanel(gui, frame, 330 if wide else 170), 0.4),
                ],
            ),
            ("Move", [(lambda: MovePanel(gui, send, frame, self.client.scene), 0.25)]),
            ("Timeline", [(lambda: TimelinePanel(gui, send, frame), 0.5)]),
            ("A/B", [(lambda: VersusPanel(gui, send, frame, self._choices), 0.5)]),
            ("Failures", [(lambda: FailuresPanel(gui, send, frame), 0.5)]),
            ("Train", [(lambda: TrainingPanel(gui, send, frame, self._job), 1.0)]),
            ("Keep", [(lambda: KeepPanel(gui, self.session.keep, frame), 1.0)]),
        ]
        shown = []
        for name, panels in table:
            with tabs.add_tab(name):
                shown += [Shown(build(), period) for build, period in panels]
        self._curves = next(s.panel for s in shown if isinstance(s.panel, FeaturesPanel))
        return shown

    def _explain(self, target: Target | None) -> None:
        self.session.send(SetSaliency(target))

    def _toggle(self, camera: str) -> None:
        """Drops a camera, or takes it back in the modalities the policy knows."""
        frame = self._newest
        if isinstance(frame, Frame):
            state = frame.camera(camera)
            back = untouched(frame.policy).input
            switch = back if state.input == "off" else "off"
            self.session.send(SetCamera(camera, CameraState(switch, state.occlusion)))

    def _keys(self, frame: Frame) -> list[tuple[str, str]]:
        """Keys and what they do, for the help."""
        return [(key, label) for label, key, _ in self._shortcuts(frame)]

    def _shortcuts(self, frame: Frame) -> list[tuple[str, str, Callable[[], None]]]:
        if self._readonly:
            return []
        send = self.session.send
        table: list[tuple[str, str, Callable[[], None]]] = [
            ("Play or pause", "space", self._play_or_pause),
            ("One step", "S", lambda: send(StepOnce())),
            ("Same seed again", "R", lambda: send(Reset())),
            ("Next seed", "N", lambda: send(Reset(next_seed=True))),
            ("Full speed", "F", lambda: send(SetSpeed(None))),
            ("Normal speed", "G", lambda: send(SetSpeed(10.0))),
        ]
        for index, camera in enumerate(frame.env.cameras):
            name = camera.name
            table.append(
                (
                    f"Drop {camera.label}, or take it back",
                    str(index + 1),
                    lambda name=name: self._toggle(name),
                )
            )
        return table

    def _play_or_pause(self) -> None:
        frame = self._newest
        playing = isinstance(frame, Frame) and frame.phase == "playing"
        self.session.send(Pause() if playing else Play())


def waiting_html(text: str, error: str = "") -> str:
    """A line at the top of the main panel, with a traceback under it if there is one."""
    trace = f"<pre>{escape(error)}</pre>" if error else ""
    return f'{STYLE}<div class="mv mv-notice">{escape(text)}{trace}</div>'
