"""The end of an episode in which a camera was changed, in a real browser: sentence and scene."""

from __future__ import annotations

import re

from madviz.app.server import App
from madviz.session.commands import Pause, Reset, SetAutoNext
from madviz.session.frame import Frame
from tests.e2e.conftest import PATIENCE, Visitor
from tests.pages import sessions_shown

LINES = """() => Object.fromEntries(['a/taken', 'a/intact', 'b/taken', 'b/intact'].map(name => {
  let lines = 0;
  window.__viserMutable.nodeRefFromName['/paths/' + name].traverse(one => {
    if (one.type === 'LineSegments2') lines = one.geometry.attributes.instanceStart.count;
  });
  return [name, lines];
}))"""
"""How many lines each path has in the scene."""
TOUCHED_AT = 2
"""The decision before which the camera is dropped."""
DECISIONS = 25 - TOUCHED_AT
CAME_OF_IT = r"up to ([0-9.]+) cm from its path with all cameras"


def shown(visitor: Visitor, lines: int) -> dict[str, int]:
    """The lines of each path, once A's has so many."""
    visitor.page.wait_for_function(f"() => ({LINES})()['a/taken'] === {lines}", timeout=PATIENCE)
    return visitor.page.evaluate(LINES)


def test_an_ending_draws_both_paths_of_the_hand_and_says_how_far_they_are_apart(
    visitor: Visitor, app: App
):
    (session,) = sessions_shown(app.users).values()
    # Nothing of it passes by while a slow browser looks: it begins paused, and its end stays.
    for command in (SetAutoNext(False), Pause(), Reset()):
        session.send(command)
    try:
        visitor.until("status.phase === 'paused' && status.step === '0'")
        for step in range(1, TOUCHED_AT + 1):
            visitor.press("step")
            visitor.until(f"status.step === '{step}'")
        visitor.press("off")
        visitor.until("status.setting === 'third_a+third_b'")
        assert not any(shown(visitor, 0).values()), "before the end there is no path"
        visitor.press("▶ play")
        said = visitor.until_text(".mv-words", CAME_OF_IT)
        assert f"First person was dropped at step {TOUCHED_AT}." in said
        lines = shown(visitor, DECISIONS)
        assert lines == {"a/taken": DECISIONS, "a/intact": DECISIONS, "b/taken": 0, "b/intact": 0}
        assert isinstance(frame := session.latest, Frame) and frame.paths is not None
        (centimetres,) = re.findall(CAME_OF_IT, said)
        assert centimetres == f"{100 * frame.paths.largest:.1f}" != "0.0"
        visitor.press("again")
        assert not any(shown(visitor, 0).values()), "the next episode has none yet"
    finally:
        session.send(SetAutoNext(True))
