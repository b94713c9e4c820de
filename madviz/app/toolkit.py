"""Everything of viser 1.1 that is experimental or needs a word of explanation, in one place.

*Layout.* Panels dock left and right of the 3D scene. viser has no columns; a container becomes a
grid when it holds what ``grid`` returns. Where the script behind it does not run, it stays a list.

*Choices.* A button group is one click to any of its options, but does not show which one is active.
``Choice`` marks it, by a style that is rewritten whenever the choice changes.

*Echo.* Assigning ``handle.value`` runs the callbacks of that widget in the assigning thread, with
``event.client`` None. Every value callback begins by leaving in that case, or showing the state
would change the state.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import viser
from viser._messages import RunJavascriptMessage

from madviz.app.panel import Assign
from madviz.errors import UserError

log = logging.getLogger(__name__)

LEFT_WIDTH, LEFT_WIDTH_WIDE, RIGHT_WIDTH = 640, 790, 320
WIDE = 1600
"""Browser windows from this width on get bigger tiles."""

# What we draw keeps its colours on a light page, on dark ground: they were chosen for it, and a
# camera's colour means the same on both.
STYLE = """<style>
:root {--mv-soft:#c3c7cc; --mv-edge:#50545a; --mv-ink:#e8eaed; --mv-ground:#15171a}
:root[data-mantine-color-scheme=light] {
  --mv-soft:#3a3d42; --mv-edge:#adb5bd; --mv-ink:#2b2e33; --mv-ground:#ffffff}
:root[data-mantine-color-scheme=light] .mv:not(.mv .mv) {
  background:#25262b; border-radius:4px; padding-top:4px; margin-left:4px; margin-right:4px}
.mv {font-size:13px; line-height:1.35; color:#e8eaed; padding:0 10px 6px; letter-spacing:-0.1px}
.mv b {font-weight:600} .mv .dim {color:#9a9fa6} .mv table {border-collapse:collapse; width:100%}
.mv td {padding:1px 4px 1px 0; white-space:nowrap}
.mv .num {font-variant-numeric:tabular-nums; text-align:right}
.mv .dot {display:inline-block; width:10px; height:10px; border-radius:2px; margin-right:5px}
.mv .tag {display:inline-block; padding:0 6px; border-radius:3px; font-weight:600; color:#15171a}
.mv img.strip {image-rendering:pixelated; width:100%; height:14px; display:block}
.mv h4 {margin:6px 0 3px; font-size:12px; font-weight:600; color:#9a9fa6; letter-spacing:0.3px;
  text-transform:uppercase} .mv h4 .plain {text-transform:none; font-weight:400; letter-spacing:0}
.uplot-container {margin-top:2px !important; margin-bottom:4px !important}
.mv-status {order:-2}
:root[data-mantine-color-scheme=light] .uplot canvas {filter:drop-shadow(0 0 1px #00000099)}
.mv pre {white-space:pre-wrap; font-size:11px; max-height:160px; overflow:auto; margin:4px 0}
</style>"""


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
    page cannot send, somebody else has sent in its name, so nothing of it is taken for granted."""
    try:
        work()
    except UserError as error:
        notify(client, "That did not work", str(error))
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        log.warning("a page sent what no page sends (%r)", error)
        notify(client, "That did not work", "The page sent a value that means nothing here.")


class Cell(NamedTuple):
    """Where a widget goes in a grid."""

    handle: Any
    column: int
    """From 1."""
    span: int = 1
    label: str = "4.2em"
    """Width of its label; ``above`` puts the label on top."""
    button: str = "0"
    """Least width of its buttons."""


def grid(name: str, columns: int, cells: Sequence[Cell]) -> str:
    """HTML, invisible, that lays out the container it is in: the widgets of ``cells`` where they
    say, everything else across all columns. Needs ``run_layout`` once per page."""
    here = f'[data-mv-grid="{name}"]'
    rules = [
        f"{here} {{display:grid; grid-template-columns:repeat({columns}, minmax(0, 1fr));"
        "padding-left:7px; padding-right:7px}",
        f"{here} > * {{grid-column:1 / -1; min-width:0; margin-left:-7px; margin-right:-7px}}",
    ]
    for cell in cells:
        box = f"{here} > {selector(cell.handle)}"
        rules.append(
            f"{box} {{grid-column:{cell.column} / span {cell.span}; margin:0; "
            "padding:0 3px 6px !important}"
        )
        if cell.label == "above":
            rules.append(f"{box} > div {{flex-direction:column; align-items:stretch !important}}")
            rules.append(f"{box} > div > div:first-child {{width:auto !important; font-size:13px}}")
            rules.append(f"{box} button {{flex-basis:{cell.button} !important}}")
        else:
            rules.append(f"{box} > div > div:first-child {{width:{cell.label} !important}}")
    ids = " ".join(cell.handle._impl.uuid for cell in cells)
    return (
        f'<div class="mv-grid" data-name="{name}" data-cells="{ids}"></div>'
        f"<style>{chr(10).join(rules)}</style>"
    )


def selector(handle: Any) -> str:
    """CSS of the box around a widget that is a cell of some grid."""
    return f'[data-mv-id="{handle._impl.uuid}"]'


_LAYOUT = """
const label = (element, name, value) => {
  if (element.dataset[name] !== value) element.dataset[name] = value;
};
const settle = marker => {
  const container = marker.parentElement.parentElement;
  label(container, 'mvGrid', marker.dataset.name);
  for (const id of marker.dataset.cells.split(' ')) {
    let box = document.getElementById(id) ?? document.querySelector(`label[for="${id}"]`);
    while (box && box.parentElement !== container) box = box.parentElement;
    if (box) label(box, 'mvId', id);
  }
};
const all = () => document.querySelectorAll('.mv-grid').forEach(settle);
const matters = record => record.target.dataset?.mvGrid !== undefined
  || [...record.addedNodes].some(node => node.querySelector?.('.mv-grid'));
if (!window.madvizLayout) {
  window.madvizLayout = new MutationObserver(records => records.some(matters) && all());
  window.madvizLayout.observe(document.body, {childList: true, subtree: true});
}
all();
"""


_PHONE = """
const narrow = matchMedia('(max-width: 36em)');
const arrange = () => {
  const image = document.querySelector('.mv-mosaic'), status = document.querySelector('.mv-status');
  if (!narrow.matches || !image || !status) return;
  const sheet = image.closest('.mantine-Paper-root');
  if (!sheet || !sheet.contains(status) || sheet.dataset.mvPhone) return;
  let section = image, piece = status;
  while (!section.parentElement.contains(status)) section = section.parentElement;
  const root = section.parentElement;
  for (piece = piece.parentElement; piece !== root; piece = piece.parentElement)
    piece.style.display = 'contents';
  root.style.display = 'flex';
  root.style.flexDirection = 'column';
  section.style.order = -1;
  sheet.style.width = '100%';
  sheet.style.maxHeight = '75%';
  for (const box of sheet.querySelectorAll('div'))
    if (box.style.width === '20em') box.style.width = '100vw';
  sheet.dataset.mvPhone = 'done';
};
if (!window.madvizPhone) window.madvizPhone = setInterval(arrange, 500);
arrange();
"""
# viser shows all panels on a phone in one sheet, two thirds as wide as the screen, the main one
# first and the others closed under it. There the status and the pictures come first.


def run_layout(client: viser.ClientHandle) -> None:
    """Starts what gives the containers and cells of grids their names in the page, and what puts
    the pictures first on a phone.

    CSS alone could find them, with ``:has``; but then the browser looks for every label again at
    every change of the page, and that took 47 of 75 ms of each update.
    """
    run_script(client, _LAYOUT)
    run_script(client, _PHONE)


def run_script(client: viser.ClientHandle, source: str) -> None:
    """Runs our own JavaScript in a visitor's page."""
    client._websock_connection.queue_message(RunJavascriptMessage(source=source))


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

        # Coroutines run in the thread that heard the click; anything else waits for another one,
        # and on a busy machine that was up to 0.15 s.
        @self.handle.on_click
        async def _(event: viser.GuiEvent) -> None:
            client = event.client
            if client is None or event.target.value not in said:
                return
            guarded(client, lambda: on_choice(client, said[event.target.value]))

    def style(self, active: str, disabled: bool = False) -> str:
        """CSS that marks the active button."""
        row = selector(self.handle)
        rules = f"{row} button {{color:var(--mv-soft); border-color:var(--mv-edge); padding:0 5px}}"
        if active in self._values:
            place = self._values.index(active) + 1
            rules += (
                f"{row} button:nth-child({place}) "
                "{background:var(--mv-ink); color:var(--mv-ground); border-color:var(--mv-ink)}"
            )
        if disabled:
            rules += f"{row} {{opacity:0.45; pointer-events:none}}"
        return rules


class Shown:
    """Shows a state in an input widget when the state changes, not with every frame: a frame that
    is a moment old would take back what a visitor has just chosen, before a callback could read
    it."""

    def __init__(self, handle: Any) -> None:
        self.handle, self._last = handle, handle.value

    def show(self, value: Any, force: bool = False) -> list[Assign]:
        if value == self._last and not force:
            return []
        self._last = value
        return [Assign(self.handle, "value", value)]


def on_value(handle: Any, work: Callable[[viser.ClientHandle, Any], None]) -> None:
    """Calls ``work(client, value)`` when a visitor changes ``handle``; never for our own
    assignments."""

    @handle.on_update
    async def _(event: viser.GuiEvent) -> None:
        client = event.client
        if client is None:
            return
        guarded(client, lambda: work(client, event.target.value))


def on_press(button: viser.GuiButtonHandle, work: Callable[[], None]) -> None:
    """Calls ``work`` when a visitor presses ``button``; its UserError becomes a note."""

    @button.on_click
    def _(event: viser.GuiEvent) -> None:
        if event.client is not None:
            guarded(event.client, work)


def remove_all(handles: Sequence[Any]) -> None:
    """Takes widgets off the page."""
    for handle in handles:
        handle.remove()
