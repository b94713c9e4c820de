"""A policy that takes seconds for a decision: its page answers all the same."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from statistics import median

import pytest

from madviz.app.layout import Shared
from madviz.app.server import App
from madviz.envs.registry import make_env
from madviz.session.session import Session
from madviz.types import Array, Encoded, Readout
from tests.e2e.conftest import PATIENCE, Visitor
from tests.fakes import FakePolicy, policies
from tests.pages import choices_of

TAKES = 3.0
"""Seconds of a decision."""
REACTS = 500
"""Milliseconds in which a switch is seen."""


class Slow(FakePolicy):
    """Takes ``TAKES`` for each set of cameras, as a large policy behind a wire does."""

    def __init__(self) -> None:
        super().__init__("toy-slow")
        self.spec = replace(self.spec, reads_together=False)
        self.read_masks: list[list[bool]] = []

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        time.sleep(TAKES)
        self.read_masks.append(masks[0].tolist())
        return super().read(encoded, masks)


@pytest.fixture
def slow() -> Slow:
    return Slow()


@pytest.fixture
def app(slow: Slow) -> Iterator[App]:
    """The first simulation has the slow policy, all others a quick one."""
    first = iter([slow])

    def new_session() -> Session:
        return Session(make_env, next(first, None) or policies("toy-mad"), policies)

    app = App(new_session, Shared(choices_of("toy-mad"), greets=False))
    yield app
    app.stop()


NOTES_PRESSES = """
for (const kind of ['click', 'keydown'])
  addEventListener(kind, () => { window.pressed = performance.now(); }, true);
"""


def takes(visitor: Visitor, act: Callable[[], None], condition: str) -> int:
    """Milliseconds from the click or the key to when the page shows ``condition``."""
    act()
    taken = visitor.page.wait_for_function(
        f"""() => {{
          const status = document.querySelector('.mv-status')?.dataset ?? {{}};
          return ({condition}) && performance.now() - window.pressed;
        }}""",
        timeout=PATIENCE,
    )
    return round(taken.json_value())


def test_the_page_of_a_slow_policy_answers(
    app: App, slow: Slow, visit: Callable[[str], Visitor]
) -> None:
    visitor = visit(app.url)
    other = visit(app.url)
    words = visitor.until_text(".mv-words", "Waiting for the policy: [12] s")
    assert "counts from its next decision on" in words
    switches, pauses = presses(visitor)
    quick, _ = presses(other)
    print("milliseconds of switches and pauses, and of a quick policy:", switches, pauses, quick)
    machine = median(quick)  # A page that another policy does not slow down takes so long here.
    assert median(switches) < REACTS + machine and median(pauses) < REACTS + machine
    assert steps_in(other, 1.5) > 5, "the other visitor keeps its pace of 10 a second"
    asked = len(slow.read_masks)
    visitor.press("off")
    visitor.until("status.setting === 'third_a+third_b'")
    before = int(visitor.status("step"))
    visitor.until(f"Number(status.step) > {before + 1}")
    assert visitor.status("setting") == "third_a+third_b"
    assert [False, True, True] in slow.read_masks[asked : asked + 3]
    assert min(help_opens(visitor)) < REACTS + min(help_opens(other)), "as on the other page"


def help_opens(visitor: Visitor) -> list[int]:
    """Milliseconds until the help is there; one of them may fall together with other work."""
    shown = "document.querySelector('[role=dialog]')"
    found: list[int] = []
    for _ in range(3):
        found.append(takes(visitor, lambda: visitor.page.keyboard.press("?"), shown))
        dialog = visitor.page.get_by_role("dialog")
        dialog.get_by_role("button", name="close", exact=True).click()
        dialog.wait_for(state="hidden")
    return found


def presses(visitor: Visitor) -> tuple[list[int], list[int]]:
    """Milliseconds until switches are seen, and until pauses are."""
    visitor.page.evaluate(NOTES_PRESSES)
    switches: list[int] = []
    pauses: list[int] = []
    for _ in range(3):
        for label, setting in (("off", "third_a+third_b"), ("on", "all")):
            shown = f"status.setting === '{setting}'"
            switches.append(takes(visitor, lambda name=label: visitor.press(name), shown))
        for label, phase in (("pause", "paused"), ("▶ play", "playing")):
            shown = f"status.phase === '{phase}'"
            pauses.append(takes(visitor, lambda name=label: visitor.press(name), shown))
    return switches, pauses


def steps_in(visitor: Visitor, seconds: float) -> int:
    """Steps that are shown in that time, early in an episode of 25: its end is held."""
    episode = visitor.status("episode")
    visitor.press("again")
    visitor.until(f"status.episode !== '{episode}'")
    start = int(visitor.status("step"))
    visitor.page.wait_for_timeout(1000 * seconds)
    return int(visitor.status("step")) - start
