"""One visitor's page: panels around the scene, and the thread that keeps them up to date.

Frames come from the session's thread into a slot for one; the page's thread takes the newest, lets
every panel that is due compute, and assigns all changes in one ``atomic`` block. A slow page skips
frames and never slows the simulator.

The first frame after a touch is drawn by the session's own thread, which has it already: every
change of threads would be a wait for a core, and at full speed all cores are taken.
"""

from __future__ import annotations

import logging
import threading
import time
import traceback
from html import escape

import viser

from madviz.app.layout import Panels, Shared
from madviz.app.markup import error_html
from madviz.app.panel import apply
from madviz.app.panels.words import Prediction
from madviz.app.toolkit import WidgetPanel, window_is_wide
from madviz.policies.no_policy import NO_POLICY
from madviz.session.frame import Change, Frame, NoFrame
from madviz.session.live_session import LiveSession

log = logging.getLogger(__name__)

STAYS = 10.0
"""Seconds for which the page still says why there was no frame, once there are frames again."""


class Page:
    """See the module. ``readonly`` pages watch somebody else's session."""

    def __init__(
        self,
        client: viser.ClientHandle,
        session: LiveSession,
        shared: Shared,
        notice: str = "",
        readonly: bool = False,
    ) -> None:
        self.client = client
        self.session = session
        self._shared = shared
        self._notice = notice
        self._readonly = readonly
        self._wide = window_is_wide(client)
        self._greets = shared.greets
        """Until it has: whoever comes is offered a comparison once."""
        self._measures = True
        """Whether success is measured for this page, as its visitor left the switch."""
        self._prediction = Prediction()
        self._waiting: viser.GuiHtmlHandle | None = None
        self._panels: Panels | None = None
        self._wanted: object = None
        """Task, cameras, and whether there is no policy, whose panels were to be built last."""
        self._reported = ""
        self._said: float | None = None
        """When the page said that there is no frame."""
        self._expected: Change | None = None
        self._drawing = threading.Lock()
        self._urgent = threading.Event()
        """Somebody has touched a camera and waits for ``_drawing``."""
        self._newest: Frame | NoFrame | None = None
        self._wake = threading.Event()
        self._closing = threading.Event()
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
            self._shared.rates.subscribe(self.poke)

    def show(self, frame: Frame | NoFrame) -> None:
        """Takes a frame, from any thread; an older one that was not shown yet is left out. If it is
        the first one since its visitor touched a camera, it is on its way before this returns."""
        self._newest = frame
        change = frame.world.change if isinstance(frame, Frame) else None
        fresh = change is not None and change is not self._expected and not self._readonly
        self._expected = change
        if fresh and self._panels is not None:
            self._urgent.set()
            self._draw()
            self._urgent.clear()
        self._wake.set()

    def poke(self) -> None:
        """Shows the newest frame again: something beside it has changed."""
        if self._panels is not None:
            self._panels.refresh.again()
        self._wake.set()

    def close(self) -> None:
        """Lets go of session and thread; the browser may have left already."""
        with self._beginning:
            self._closing.set()
        self.session.unsubscribe(self.show)
        self._shared.rates.unsubscribe(self.poke)
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._shared.rates.forget(self.client.client_id)

    def clear(self) -> None:
        """Takes everything off the page, after ``close``."""
        self._strip()
        if self._waiting is not None:
            self._waiting.remove()

    def _strip(self) -> None:
        """Takes panels and scene off the page."""
        panels = self._panels
        self._panels = None
        if panels is not None:
            if panels.success is not None:
                self._measures = panels.success.measures
            panels.remove()

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
                return self._push(self._newest, time.monotonic()) if self._newest else None
            except Exception:
                # A panel that fails must not take the page down; the next frame may be fine.
                self._report(traceback.format_exc())
                return None

    def _report(self, error: str) -> None:
        """Says once, in the log and on the page, that a frame could not be shown."""
        if error != self._reported and self._waiting is not None:
            self._reported = error
            log.error("a frame could not be shown\n%s", error)
            self._waiting.content = waiting_html("A frame could not be shown.", error)

    def _push(self, frame: Frame | NoFrame, now: float) -> float | None:
        """Shows ``frame``. Returns in how many seconds a panel that was left out is due."""
        assert self._waiting is not None
        if isinstance(frame, NoFrame):
            self._waiting.content = waiting_html(frame.title, frame.error)
            self._said = None if frame.passing else now
            return None
        if self._said is not None and now > self._said + STAYS:
            self._said = None
            self._waiting.content = waiting_html(self._notice) if self._notice else ""
        without = frame.world.policy.method == NO_POLICY
        wanted = (frame.world.env.task, frame.world.env.cameras, without)
        if wanted != self._wanted:  # Once: what cannot be built now cannot at the next frame.
            self._wanted = wanted
            self._build(frame)
        panels = self._panels
        if panels is None:
            return None
        changes = panels.refresh.update(frame, now, self._urgent.is_set)
        with self.client.atomic():  # One message, because each one costs the browser a frame.
            apply(changes)
        self.client.flush()
        if self._reported:  # A later frame was shown, so nothing is broken.
            self._reported = ""
            self._waiting.content = waiting_html(self._notice) if self._notice else ""
        return panels.refresh.wait(frame, now)

    def _build(self, frame: Frame) -> None:
        greet = self._greets
        self._greets = False
        self._strip()
        self._prediction.take("")  # It was about the robot that is gone.
        assert self._waiting is not None
        if self._said is None:
            self._waiting.content = waiting_html(self._notice) if self._notice else ""
        with self.client.atomic():
            self._panels = Panels(
                self.client,
                self.session,
                self._shared,
                frame,
                lambda: self._newest,
                wide=self._wide,
                readonly=self._readonly,
                greet=greet,
                measures=self._measures,
                prediction=self._prediction,
            )
        for timed in self._panels.panels:
            if isinstance(timed.panel, WidgetPanel):
                timed.panel.again = self.poke


def waiting_html(text: str, error: str = "") -> str:
    """A line at the top of the main panel, and what went wrong under it."""
    return f'<div class="mv mv-notice">{escape(text)}{error_html("", error) if error else ""}</div>'
