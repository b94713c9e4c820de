"""Thirty copies of a lesson as a class returns them, to see how long grading takes:

    python -m tests.returned_copies 02_merge returned
    madviz grade returned --lessons build/class/student --workers 2 --json grades.json

Eighteen are right. Two each are empty, wrong, crash, never end, want too much memory; of one the
checks were edited, and one is no notebook.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import nbformat
from nbformat import NotebookNode

ROOT = Path(__file__).resolve().parent.parent


def tagged(notebook: NotebookNode, tag: str) -> list[NotebookNode]:
    return [cell for cell in notebook.cells if tag in cell.metadata.get("tags", [])]


def right(notebook: NotebookNode) -> None:
    """As the teacher's copy, whose solutions follow the empty answers."""


def empty(notebook: NotebookNode) -> None:
    notebook.cells = [c for c in notebook.cells if "solution" not in c.metadata.get("tags", [])]


def answering(text: str) -> Callable[[NotebookNode], None]:
    def change(notebook: NotebookNode) -> None:
        empty(notebook)
        for cell in tagged(notebook, "answer"):
            cell.source = text

    return change


def edited(notebook: NotebookNode) -> None:
    empty(notebook)
    for cell in tagged(notebook, "check"):
        cell.source = 'print("right")'


KINDS: dict[str, tuple[int, Callable[[NotebookNode], None]]] = {
    "right": (18, right),
    "empty": (2, empty),
    "wrong": (2, answering("merge = mean = lambda features, present: features.sum(0)")),
    "crashing": (2, answering("import os\nos._exit(1)")),
    "endless": (2, answering("while True: pass")),
    "hungry": (2, answering("numbers = bytearray(40 << 30)")),
    "edited": (1, edited),
}
"""How many, and what is done to a copy."""


def make(lesson: str, out: Path) -> int:
    """Writes the copies to OUT/STUDENT/LESSON.ipynb; how many."""
    whole = nbformat.read(ROOT / "notebooks" / f"{lesson}.ipynb", 4)
    made = 0
    for kind, (count, change) in KINDS.items():
        for number in range(1, count + 1):
            copy, made = deepcopy(whole), made + 1
            change(copy)
            folder = out / f"{kind}{number:02}"
            folder.mkdir(parents=True)
            nbformat.write(copy, folder / f"{lesson}.ipynb")
    (out / "essay01").mkdir()
    (out / "essay01" / f"{lesson}.ipynb").write_text("I could not open it.")
    return made + 1


if __name__ == "__main__":
    print(make(sys.argv[1], Path(sys.argv[2])), "copies")
