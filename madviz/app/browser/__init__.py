"""Styles and scripts that run in a visitor's browser, each a file of its own in this folder."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files

import viser
from viser._messages import RunJavascriptMessage

SCRIPTS = ("title", "grid", "phone", "screen", "patch", "help_key", "gpu_note")
"""The script that every page runs."""

_ADD_STYLE = """
const style = document.createElement('style');
style.textContent = {css};
document.head.append(style);
"""


@cache
def read(name: str) -> str:
    """The text of one of the files here, for example ``grid.js``."""
    return files(__name__).joinpath(name).read_text("utf-8")


def equip(client: viser.ClientHandle) -> None:
    """Gives a visitor's page our styles and scripts; before anything that needs them."""
    run_once(client, "style", _ADD_STYLE.format(css=json.dumps(read("page.css"))))
    for name in SCRIPTS:
        run_once(client, name, read(f"{name}.js"))


def note_visit(client: viser.ClientHandle, visit: str) -> None:
    """Tells a page the name of its visit, '' where it has no simulation of its own. One whose
    connection was cut says that it began anew."""
    source = read("returned.js").replace("VISIT;", f"{json.dumps(visit)};")
    source = source.replace("=== VISIT)", f"=== {json.dumps(visit)})")
    client._websock_connection.queue_message(RunJavascriptMessage(source=source))


def run_once(client: viser.ClientHandle, name: str, source: str) -> None:
    """Runs JavaScript in a visitor's page, unless it has run a script of this ``name`` since it was
    loaded: a page whose connection was lost for a moment comes again as another client."""
    guard = f"const ran = window.madvizRan ??= {{}}; if (ran.{name}) return; ran.{name} = true;\n"
    client._websock_connection.queue_message(RunJavascriptMessage(source=guard + source))
