"""Copies of the lessons for a class, in build/class: ``python tools/student_copies.py [OUT]``.

    build/class/student/        no outputs, no solutions, predictions open; what is handed out
                student-html/   the same to read in a browser
                teacher/        with outputs and solutions, as they are in notebooks/
                teacher-html/

Which cells are a solution, a prediction or a check is said by their tags (madviz/teaching/checks).
Cells keep their identifiers, by which `madviz grade` finds the checks again. Formulas in the HTML
are drawn by MathJax, which a browser fetches; without a network they stay as they are typed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import nbformat
from nbconvert import HTMLExporter
from nbformat import NotebookNode

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "notebooks"
WIDGET = "application/vnd.jupyter.widget-view+json"
KEPT = ("answer", "check", "prediction")
"""Tags that a student's copy keeps."""


def tags(cell: NotebookNode) -> set[str]:
    return set(cell.metadata.get("tags", []))


def student_copy(notebook: NotebookNode) -> NotebookNode:
    """What a student gets of a lesson."""
    copy = deepcopy(notebook)
    copy.cells = [cell for cell in copy.cells if "solution" not in tags(cell)]
    for cell in copy.cells:
        kept = sorted(tags(cell) & set(KEPT))
        cell.metadata = NotebookNode(tags=kept) if kept else NotebookNode()
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    copy.metadata.pop("widgets", None)
    return copy


def teacher_copy(notebook: NotebookNode) -> NotebookNode:
    """All of it."""
    return deepcopy(notebook)


def page(notebook: NotebookNode, name: str) -> str:
    """HTML to read. A widget has no kernel there, so its HTML is shown; no widget library is
    fetched."""
    shown = deepcopy(notebook)
    shown.metadata.pop("widgets", None)
    for cell in shown.cells:
        for output in cell.get("outputs", []):
            output.get("data", {}).pop(WIDGET, None)
    exporter = HTMLExporter(require_js_url="", jupyter_widgets_base_url="")
    body, _ = exporter.from_notebook_node(shown, {"metadata": {"name": name}})
    return body


COPIES: dict[str, Callable[[NotebookNode], NotebookNode]] = {
    "student": student_copy,
    "teacher": teacher_copy,
}


def make(out: Path, notebooks: Path = NOTEBOOKS) -> list[Path]:
    """Writes all copies. Returns the notebooks that are handed out. Ends, with nothing written,
    where copies are there already: answers may be in them."""
    there = [out / kind for kind in COPIES if (out / kind).exists()]
    if there:
        raise SystemExit(
            f"expected no folder {there[0]}, found one, in which answers may be; rename "
            f"{there[0].parent}, or name another: python tools/student_copies.py OUT"
        )
    for kind, copied in COPIES.items():
        folder, pages = out / kind, out / f"{kind}-html"
        for one in (folder, pages):
            one.mkdir(parents=True, exist_ok=True)
        for file in sorted(notebooks.glob("*.ipynb")):
            copy = copied(nbformat.read(file, 4))
            nbformat.write(copy, folder / file.name)
            (pages / f"{file.stem}.html").write_text(page(copy, file.stem))
    return sorted((out / "student").glob("*.ipynb"))


if __name__ == "__main__":
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "build" / "class"
    made = make(out)
    print(f"{len(made)} lessons: hand out {out / 'student'}, keep {out / 'teacher'}")
