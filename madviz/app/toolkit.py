"""Everything of viser 1.1 that is experimental or needs a word of explanation, in one place.

*Layout.* Panels dock left and right of the 3D scene. viser has no columns; a container becomes a
grid when ``place`` has been there. Where the script behind it does not run, it stays a list.

*Choices.* A button group is one click to any of its options, but does not show which one is active.
``Choice`` marks it, by a style that is rewritten whenever the choice changes.

*Echo.* Assigning ``handle.value`` runs the callbacks of that widget in the assigning thread, with
``event.client`` None. Every value callback begins by leaving in that case, or showing the state
would change the state.
"""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Coroutine, Sequence
from html import escape
from typing import Any, NamedTuple

import viser

from madviz.app.connection import MISTAKES, is_downloading, note
from madviz.app.panel import Assign, Panel, apply
from madviz.errors import UserError
from madviz.session.frame import Frame

LEFT_WIDTH = 440
LEFT_WIDTH_WIDE = 640
RIGHT_WIDTH = 310
WIDE = 1600
"""Browser windows from this width on get bigger tiles. The scene has 41 % of 1280 pixels, and half
of 1920."""


def theme(gui: viser.GuiApi, light: bool) -> None:
    """Light or dark, for one page or, by the server's ``gui``, for all that come."""
    gui.configure_theme(
        dark_mode=not light, show_logo=False, show_share_button=False, brand_color=(77, 140, 200)
    )


def dock(client: viser.ClientHandle, wide: bool) -> viser.PanelHandle:
    """The left panel; the main panel goes to the right, the scene stays between them."""
    panel = client.gui.add_panel()
    panel.dock_left()
    panel.set_width(LEFT_WIDTH_WIDE if wide else LEFT_WIDTH)
    client.gui.main_panel.dock_right()
    client.gui.main_panel.set_width(RIGHT_WIDTH)
    panel.expand()  # On a phone it would begin closed.
    return panel


def window_is_wide(client: viser.ClientHandle) -> bool:
    """Whether the 3D canvas, which fills the window before panels dock, is wide."""
    return client.camera.image_width >= WIDE


def notify(client: viser.ClientHandle, title: str, body: str, seconds: float = 8.0) -> None:
    """A note in the corner of the scene that goes away by itself."""
    client.add_notification(title, body, auto_close_seconds=seconds, color="orange")


def download(client: viser.ClientHandle, name: str, content: bytes) -> None:
    """Gives the visitor a file. Raises UserError while another one is on its way: to a browser that
    does not read, files would pile up."""
    if is_downloading(client):
        raise UserError("expected one file at a time, found another on its way; wait for it")
    client.send_file_download(name, content, save_immediately=True)


def commands(
    client: viser.ClientHandle, table: Sequence[tuple[str, Any, Callable[[], None]]]
) -> list[viser.CommandHandle]:
    """Registers (label, hotkey, what it does) with the page's command palette (Ctrl/Cmd + K)."""
    handles = []
    for label, hotkey, work in table:
        handle = client.gui.add_command(label, hotkey=hotkey)
        handle.on_trigger(lambda _, work=work: work())
        handles.append(handle)
    return handles


def guarded(client: viser.ClientHandle, work: Callable[[], None]) -> None:
    """Runs ``work``; a value that the page should not have sent becomes a note on the page. What a
    page cannot send was sent by a program that imitates one, so nothing of it is trusted."""
    try:
        work()
    except UserError as error:
        notify(client, "That did not work", str(error))
    except OSError as error:  # A folder that takes no files, a full disk.
        where = f"{error.filename}: " if error.filename else ""
        notify(client, "That did not work", f"{where}{error.strerror or error}")
    except MISTAKES as error:
        if note(client._websock_connection, error):
            notify(client, "That did not work", "The page sent a value that means nothing here.")


def heard(work: Callable[[Any], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
    """``work`` as a coroutine, for what is done at once. viser calls coroutines in the thread that
    heard the visitor. Anything else goes to its threads for callbacks, behind what waits there for
    all visitors: on a busy machine that was up to 0.15 s, and nothing bounds how much waits."""

    async def callback(event: Any) -> None:
        work(event)

    return callback


def one_at_a_time(work: Callable[[Any], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
    """``work`` for what takes its time, in a thread of its own. Whoever presses again meanwhile has
    pressed once: a visitor can keep one thread busy for each such button, never a row of jobs."""
    busy = threading.Lock()

    async def callback(event: Any) -> None:
        if not busy.acquire(blocking=False):
            return
        try:
            await asyncio.to_thread(work, event)
        finally:
            busy.release()

    return callback


def forget_camera(camera: viser.CameraHandle, callback: Any) -> None:
    """Takes back ``camera.on_update(callback)``; a callback keeps alive all that it reads."""
    if callback in camera._state.camera_cb:
        camera._state.camera_cb.remove(callback)


class Cell(NamedTuple):
    """Where a widget goes in a grid."""

    handle: Any
    column: int
    """From 1."""
    span: int = 1
    label: str = "4.2em"
    """Width of its label; ``above`` puts the label on top, ``none`` leaves it out."""


def place(gui: viser.GuiApi, name: str, columns: int, cells: Sequence[Cell]) -> list[Any]:
    """Lays out the container that ``cells`` are in: their widgets where they say, everything else
    across all columns (``browser/grid.js``). Returns all handles, that of the layout's invisible
    HTML too."""
    places = [{**cell._asdict(), "handle": cell.handle._impl.uuid} for cell in cells]
    layout = gui.add_html(
        f'<div class="mv-grid" data-name="{name}" data-columns="{columns}" '
        f'data-cells="{escape(json.dumps(places))}"></div>'
    )
    return [*(cell.handle for cell in cells), layout]


def selector(handle: Any) -> str:
    """CSS of the box around a widget that is a cell of some grid."""
    return f'[data-mv-id="{handle._impl.uuid}"]'


class Choice:
    """A row of buttons of which one is active, and shown as active."""

    def __init__(
        self,
        gui: viser.GuiApi,
        label: str,
        options: dict[str, str],
        on_choice: Callable[[viser.ClientHandle, str], None],
        hint: str | None = None,
    ) -> None:
        """``options`` maps values to what the buttons say."""
        self._values = list(options)
        said = {text: value for value, text in options.items()}
        self.handle = gui.add_button_group(label, list(said), hint=hint)

        def choose(client: viser.ClientHandle, text: str) -> None:
            if text in said:
                on_choice(client, said[text])

        on_use(self.handle, choose)

    def style(self, *active: str, opened: str = "") -> str:
        """CSS that marks the active buttons, and the one whose panel is ``opened`` by a frame."""
        row = selector(self.handle)
        rules = f"{row} button {{color:var(--mv-soft); border-color:var(--mv-edge); padding:0 2px}}"
        for place in (self._values.index(one) + 1 for one in active if one in self._values):
            rules += (
                f"{row} button:nth-child({place}) "
                "{background:var(--mv-ink); color:var(--mv-ground); border-color:var(--mv-ink)}"
            )
        if opened and opened not in active:
            place = self._values.index(opened) + 1
            frame = "{color:var(--mv-ink); border-color:var(--mv-ink)}"
            rules += f"{row} button:nth-child({place}) {frame}"
        return rules


class SyncedInput:
    """An input widget that follows a state when the state changes, not with every frame: an older
    frame would take back what a visitor has just chosen, before a callback could read it."""

    def __init__(self, handle: Any) -> None:
        self.handle = handle
        self._last = handle.value
        self._held: Any = None

    def hold(self, value: Any) -> None:
        """Keeps the ``value`` that a slider was dragged to until a state confirms it: it must not
        jump back."""
        self._held = value

    def release(self) -> None:
        """Follows the state again, whatever the slider was dragged to."""
        self._held = None

    def confirms(self, value: Any) -> bool:
        """True where a state with ``value`` is what the visitor asked for."""
        return self._held in (None, value)

    def show(self, value: Any, force: bool = False) -> list[Assign]:
        """The change where ``value`` is another than the last one; always if ``force``."""
        if not self.confirms(value):
            return []
        self.release()
        if value == self._last and not force:
            return []
        self._last = value
        return [Assign(self.handle, "value", value)]


def on_use(
    handle: Any,
    work: Callable[[viser.ClientHandle, Any], None],
    how: Callable[[Callable[[Any], None]], Any] = heard,
) -> None:
    """Calls ``work(client, value)`` when a visitor presses ``handle`` or changes it; never for our
    own assignments. Its UserError becomes a note. ``how``: ``heard`` or ``one_at_a_time``."""

    def used(event: viser.GuiEvent) -> None:
        client = event.client
        if client is not None:
            guarded(client, lambda: work(client, event.target.value))

    register = getattr(handle, "on_click", None) or handle.on_update
    register(how(used))


class WidgetPanel(Panel):
    """Base of a panel that is made of widgets: whatever is in ``handles`` is taken off the page."""

    handles: Sequence[Any] = ()
    again: Callable[[], None] = staticmethod(lambda: None)
    """Asks for one more ``update`` with the newest frame; the page puts in its own."""

    def show(self, changes: list[Assign]) -> None:
        """Assigns at once what a visitor has chosen. The page's thread may be about to assign what
        it computed before that, and while an episode is paused no frame would correct it, so this
        also asks for one more update."""
        apply(changes)
        self.again()

    def remove(self) -> None:
        """See ``panel.Panel``."""
        for handle in self.handles:
            handle.remove()


class HtmlPanel(WidgetPanel):
    """Base of a panel whose last widget is a text, which is made anew for every frame."""

    def __init__(self, gui: viser.GuiApi, frame: Frame, html: Callable[[Frame], str]) -> None:
        """Adds the text, ``html`` of a frame; what stands above it is in ``handles`` already."""
        self._html = html
        self._text = gui.add_html(html(frame))
        self.handles = [*self.handles, self._text]

    def update(self, frame: Frame) -> list[Assign]:
        """See ``panel.Panel``."""
        return [Assign(self._text, "content", self._html(frame))]
