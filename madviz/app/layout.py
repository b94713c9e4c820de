"""The panels of a page and their places: every panel, and how often it is brought up to date.

left    what the cameras send, their switches, the words; under them one tab for each analysis
middle  the scene, and the arrows in it
right   who acts and how fast, success by subset
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import viser

from madviz.analysis.saliency import Target
from madviz.app.keys import Keys
from madviz.app.live_audit import LiveAudit
from madviz.app.panel import Newest, Panel
from madviz.app.panels.audit import AuditPanel
from madviz.app.panels.breaks import BreakPanel
from madviz.app.panels.cameras import CamerasPanel
from madviz.app.panels.comparison import ComparisonPanel
from madviz.app.panels.failures import FailuresPanel
from madviz.app.panels.features import FeaturesPanel
from madviz.app.panels.foresight import ForesightPanel
from madviz.app.panels.guard import GuardPanel
from madviz.app.panels.policy import PolicyChoice, PolicyPanel
from madviz.app.panels.projection import ProjectionPanel
from madviz.app.panels.recorded import RecordedPanel
from madviz.app.panels.saliency import SaliencyPanel
from madviz.app.panels.save import SavePanel
from madviz.app.panels.shapley import ShapleyPanel
from madviz.app.panels.subsets import SubsetsPanel
from madviz.app.panels.success import SuccessPanel
from madviz.app.panels.timeline import TimelinePanel
from madviz.app.panels.training import TrainingPanel
from madviz.app.panels.words import Prediction, WordsPanel
from madviz.app.refresh import FASTEST, Refresh, TimedPanel
from madviz.app.scene.arrows import ArrowsPanel
from madviz.app.scene.paths import PathsPanel
from madviz.app.scene.recorded import PicturesPanel
from madviz.app.scene.scene import ScenePanel, extent
from madviz.app.success_rates import SuccessRates
from madviz.app.toolkit import LEFT_WIDTH, LEFT_WIDTH_WIDE, commands, dock
from madviz.app.tour import Tour
from madviz.policies.no_policy import NO_POLICY
from madviz.session.commands import SetSaliency
from madviz.session.frame import Frame
from madviz.session.live_session import LiveSession
from madviz.training.job import TrainingJob

PAIRED = 156
PAIRED_WIDE = 216
"""Pixels of a camera's picture at most where there are two rows of them: then nothing has to be
scrolled in a window of 1280 x 800, or 1920 x 1080."""


@dataclass(frozen=True)
class Shared:
    """Objects that all visitors of a server have in common."""

    choices: Sequence[PolicyChoice]
    rates: SuccessRates = field(default_factory=SuccessRates)
    training: TrainingJob = field(default_factory=lambda: TrainingJob(Path("runs")))
    """Trainings from the page get folders in its own."""
    greets: bool = True
    """Whether a new visitor is offered a comparison, where there is one to offer."""

    @cached_property
    def audit(self) -> LiveAudit:
        """Asks for its episodes like one more visitor."""
        return LiveAudit(self.rates)


class Panels:
    """All panels of one page, for one task and its cameras."""

    def __init__(
        self,
        client: viser.ClientHandle,
        session: LiveSession,
        shared: Shared,
        frame: Frame,
        newest: Newest,
        *,
        wide: bool,
        readonly: bool,
        greet: bool,
        measures: bool,
        prediction: Prediction,
    ) -> None:
        """``newest`` is what the page shows last; ``wide`` windows have more room; who is
        ``readonly`` watches somebody else's session; ``greet`` offers a comparison; ``measures``
        is as in ``SuccessPanel``; ``prediction`` is the visitor's."""
        self._client = client
        self._session = session
        self._shared = shared
        self._newest = newest
        self._send = None if readonly else session.send
        self._wide = wide
        self._prediction = prediction
        gui = client.gui
        rates = shared.rates
        keys = Keys(self._send, newest, frame)
        tour = Tour(client, self._send, newest, shared.choices, keys.table, self._guessed)
        policy = PolicyPanel(gui, self._send, frame, shared.choices)
        own = None if readonly else client.client_id
        recorded = frame.world.env.recorded
        self.success = None if recorded else SuccessPanel(gui, frame, rates, own, measures)
        dockable = dock(client, wide)
        with dockable.add_tab("Cameras"):
            width = (LEFT_WIDTH_WIDE if wide else LEFT_WIDTH) - 18
            cameras = CamerasPanel(gui, self._send, frame, width, PAIRED_WIDE if wide else PAIRED)
            guard = GuardPanel(gui, self._send, frame)
            words = WordsPanel(gui, frame, rates, None if readonly else prediction)
            if self._send is not None:
                cameras.breaks = BreakPanel(gui, self._send, frame, client.scene)
            tabs = gui.add_tab_group()
        breaks = [TimedPanel(cameras.breaks, 0.1)] if cameras.breaks else []
        self._extras = [dockable, tour, *commands(client, keys.table)]
        scene = self._build_scene(frame, None if readonly else keys.toggle)
        # Every panel of the page, in the order in which they get a frame.
        self.panels = [
            TimedPanel(cameras, FASTEST),
            TimedPanel(guard, 0.25),
            TimedPanel(policy, FASTEST),
            TimedPanel(words, FASTEST),
            *breaks,
            *self._build_tabs(tabs, frame),
            TimedPanel(self.success or RecordedPanel(gui, frame), 0.5),
            *scene,
        ]
        self.refresh = Refresh(self.panels)
        if greet:
            tour.greet()

    def remove(self) -> None:
        """Takes panels and scene off the page."""
        for timed in self.panels:
            timed.panel.remove()
        for handle in self._extras:
            handle.remove()

    def _build_scene(self, frame: Frame, click: Callable[[str], None] | None) -> list[TimedPanel]:
        """Builds the middle of the page: recordings have no scene, so their pictures are there."""
        if frame.world.env.recorded:
            return [TimedPanel(PicturesPanel(self._client, frame, click), 0.05)]
        arrows = ArrowsPanel(self._client, frame, extent(frame))
        return [
            TimedPanel(ScenePanel(self._client, frame, click), 0.05),
            TimedPanel(arrows, 0.25),
            TimedPanel(PathsPanel(self._client, frame), 0.25),
        ]

    def _build_tabs(self, tabs: viser.GuiTabGroupHandle, frame: Frame) -> list[TimedPanel]:
        """Builds the panels under the cameras, a tab for each question a visitor has; the last one
        holds what is wanted now and then."""
        gui = self._client.gui
        send = self._send
        wide = self._wide
        shared = self._shared
        explain, audited = (self._explain, self._newest) if send else (None, None)
        choices = shared.choices
        built: list[TimedPanel] = []

        def add(tab: viser.GuiTabHandle, *panels: tuple[Callable[[], Panel], float]) -> None:
            with tab:
                built.extend(TimedPanel(build(), period) for build, period in panels)

        if frame.world.policy.method != NO_POLICY:
            add(
                tabs.add_tab("What counts?"),
                (lambda: FeaturesPanel(gui, frame, 230 if wide else 150), 0.25),
                (lambda: ShapleyPanel(gui, frame, shared.rates), 0.5),
            )
            add(tabs.add_tab("What if?"), (lambda: SubsetsPanel(gui, send, frame), 0.5))
            add(
                tabs.add_tab("Sees what?"),
                (lambda: SaliencyPanel(gui, explain, frame), 0.25),
                (lambda: ForesightPanel(gui, send, frame), 0.5),
                (lambda: ProjectionPanel(gui, frame, 330 if wide else 170), 0.4),
            )
        add(tabs.add_tab("Go back"), (lambda: TimelinePanel(gui, send, frame), 0.5))
        simulated = not frame.world.env.recorded
        if simulated:
            add(
                tabs.add_tab("Who wins?"),
                (lambda: ComparisonPanel(gui, send, frame, choices), 0.5),
            )
        with tabs.add_tab("More"):
            more = gui.add_tab_group()
        audit = (lambda: AuditPanel(gui, audited, frame, shared.audit), 1.0)
        train = (lambda: TrainingPanel(gui, send, frame, shared.training), 1.0)
        if simulated:
            add(more.add_tab("Audit"), audit)
        add(more.add_tab("Failures"), (lambda: FailuresPanel(gui, send, frame), 0.5))
        if simulated:
            add(more.add_tab("Train"), train)
        add(more.add_tab("Save"), (lambda: SavePanel(gui, self._session.save, frame), 1.0))
        return built

    def _guessed(self, guess: str) -> None:
        frame = self._newest()
        now = frame.world.episode if isinstance(frame, Frame) else None
        self._prediction.take(guess, asked_in=now)

    def _explain(self, target: Target | None) -> None:
        self._session.send(SetSaliency(target))
