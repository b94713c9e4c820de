"""Save what happened: an episode as a small file, to be replayed, inspected and shared."""

from __future__ import annotations

import re
from collections.abc import Callable

import viser

from madviz.app.toolkit import Cell, HtmlPanel, download, on_use, one_at_a_time, place
from madviz.session.frame import Frame
from madviz.session.session_file import SavedSession

HINTS = {
    "one": "Downloads the episode that is running: its seed, and what you did at which step.",
    "all": "Downloads the last 20 episodes, in one file.",
}


class SavePanel(HtmlPanel):
    """Two buttons, and what to do with what they save. Watchers may save, too: it only reads."""

    def __init__(
        self, gui: viser.GuiApi, keep: Callable[[bool], SavedSession], frame: Frame
    ) -> None:
        """``keep(present_only)`` saves; see ``LiveSession.save``."""
        self._keep = keep
        one = gui.add_button("save this episode", hint=HINTS["one"])
        several = gui.add_button("save the last 20", hint=HINTS["all"])
        on_use(one, lambda client, _: self._download(client, True), one_at_a_time)
        on_use(several, lambda client, _: self._download(client, False), one_at_a_time)
        self.handles = place(gui, "save", 2, [Cell(one, 1), Cell(several, 2)])
        super().__init__(gui, frame, save_html)

    def _download(self, client: viser.ClientHandle, present_only: bool) -> None:
        saved = self._keep(present_only)
        download(client, file_name(saved), saved.to_json().encode())


def file_name(saved: SavedSession) -> str:
    """``hammer-seed2003.json``; of several episodes ``hammer-20-episodes.json``."""
    last = saved.episodes[-1]
    task = _stem(last.task)
    count = len(saved.episodes)
    return f"{task}-{count}-episodes.json" if count > 1 else f"{task}-seed{last.seed}.json"


def _stem(task: str) -> str:
    """The task's part of a file name, safe on every system and in HTML."""
    return re.sub(r"[^a-z0-9-]", "", task.split("/")[-1]) or "session"


def save_html(frame: Frame) -> str:
    """The sentence that says what the file is good for."""
    name = f"{_stem(frame.world.env.task)}-seed{frame.world.seed}.json"
    rows = {
        f"madviz replay {name}": "the same again, and whether it is so to the bit",
        f"madviz explore --replay {name}": "on the page, from the first step on",
        f"madviz record --replay {name} --out X.mp4": "a film; X.html a report, X.rrd for rerun",
    }
    lines = (
        f'<tr><td style="white-space:normal"><code>{command}</code></td></tr>'
        f'<tr><td class="dim" style="white-space:normal;padding-bottom:4px">{words}</td></tr>'
        for command, words in rows.items()
    )
    return (
        '<div class="mv">The file holds no pictures: policy, seed, and every switch with its step, '
        f"some 3 KB an episode.<table>{''.join(lines)}</table></div>"
    )
