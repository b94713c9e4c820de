"""Returned copies: whose they are, of which lesson, and their checks as they were handed out.

The problem: a copy comes back under any name, and a student may have edited its checks, by mistake
or not. The idea: the notebooks that were handed out say which cells are checks. Each is put back,
where it was, as a call that asks the installed package. It takes the place of an unchanged check,
and comes after an edited one, which may hold an answer:

    handed out   teaching.check("02.merge", merge)       ─┐
    returned     merge = ...; print("02.merge: right")    ├─► report("02.merge", globals())
                                                          │   and in the table: 'check edited'
                                                         ─┘
A cell is found by its identifier, which JupyterLab keeps, or else by the name of its check. Where
it is gone it goes to the end: everything that the student wrote has run by then.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

import nbformat
from nbformat import NotebookNode

from madviz.errors import UserError, printable
from madviz.teaching.checks import CHECKS

LARGEST = 50 << 20
"""Bytes of a copy."""
NAME = re.compile(r"""check\(\s*["']([^"']+)["']""")
REPORT = '__import__("madviz.grading.inside", fromlist=["report"]).report({!r}, globals())'
"""The code that runs in place of a check; no name of it is the student's."""


@dataclass(frozen=True)
class Returned:
    """A file that came back."""

    file: Path
    student: str
    lesson: str
    """'' where its name is none of a lesson."""
    name: str
    """The path below the folder that came back, as a table can have it."""
    alike: int = 1
    """Files of this student and lesson, this one included."""


def handed_out(folder: Path) -> dict[str, NotebookNode]:
    """Lessons with checks, by name. Raises UserError where there are none, or one is broken."""
    lessons: dict[str, NotebookNode] = {}
    for path in sorted(folder.glob("*.ipynb")):
        try:
            notebook = nbformat.read(path, 4)
            if checks_of(notebook):
                lessons[path.stem] = notebook
        except Exception as error:  # Whatever half of a file may hold.
            raise UserError(
                f"expected a notebook that was handed out, found a broken one at {path} "
                f"({type(error).__name__}); put a good copy there, or move it away"
            ) from error
    if not lessons:
        raise UserError(
            f"expected the notebooks that were handed out in {folder}, found none with checks; "
            "run `make student-copies`, or name their folder with --lessons"
        )
    return lessons


def returned(folder: Path, lessons: list[str]) -> Iterator[Returned]:
    """Every file in ``folder``: STUDENT/…/LESSON.ipynb, or STUDENT_LESSON.ipynb side by side.
    Raises UserError for a folder that cannot be read."""
    found = list(_files(folder, lessons))
    alike = Counter((one.student, one.lesson) for one in found)
    for one in found:
        yield replace(one, alike=alike[one.student, one.lesson])


def _files(folder: Path, lessons: list[str]) -> Iterator[Returned]:
    for file in sorted(_below(folder)):
        inside = file.relative_to(folder)
        lesson = next((name for name in lessons if name in file.stem), "")
        alone = file.stem.replace(lesson, "").strip(" _-.") or file.stem
        student = inside.parts[0] if len(inside.parts) > 1 else alone
        yield Returned(file, printable(student), lesson, printable(str(inside)))


def _below(folder: Path) -> Iterator[Path]:
    """Files and links; what is hidden is left out."""
    for place, folders, files in os.walk(folder, onerror=_unreadable):
        folders[:] = [name for name in folders if not name.startswith(".")]
        links = [name for name in folders if os.path.islink(os.path.join(place, name))]
        yield from (Path(place, name) for name in [*links, *files] if not name.startswith("."))


def _unreadable(error: OSError) -> NoReturn:
    raise UserError(
        f"expected folders that can be read, found {error.filename}: {error.strerror}; "
        "let this account read it, or move it away"
    ) from error


def checks_of(notebook: NotebookNode) -> dict[str, NotebookNode]:
    """A lesson's cells that are checks, by the name of the check."""
    return {
        name: cell
        for cell in notebook.cells
        if (name := check_in(cell)) in CHECKS and "check" in cell.metadata.get("tags", [])
    }


def check_in(cell: NotebookNode) -> str:
    """The name of the check that a cell asks for; '' if it asks for none."""
    asked = NAME.search(cell.source) if cell.cell_type == "code" else None
    return asked[1] if asked else ""


def prepare(file: Path, lesson: NotebookNode) -> tuple[NotebookNode, frozenset[str]]:
    """A copy of ``lesson`` that can be run, its checks put back, and the checks that were not as
    they had been handed out. Raises UserError for what is no notebook."""
    notebook = read_copy(file)
    edited = set()
    cells = list(notebook.cells)
    for name, original in checks_of(lesson).items():
        same_id = [c for c in cells if c.get("id") == original.get("id") and c.cell_type == "code"]
        check = next(iter(same_id or [c for c in cells if check_in(c) == name]), None)
        if check is None or check.source.strip() != original.source.strip():
            edited.add(name)
            place = next((i + 1 for i, cell in enumerate(cells) if cell is check), len(cells))
            check = nbformat.v4.new_code_cell()
            cells.insert(place, check)  # The edited cell stays: an answer may be in it.
        check.source = REPORT.format(name)
        check.metadata = NotebookNode(madviz=name)
    notebook.cells = cells
    return notebook, frozenset(edited)


def read_copy(file: Path) -> NotebookNode:
    """A notebook of whatever version, without outputs. Raises UserError for anything else."""
    if file.is_symlink() or not file.is_file():
        raise UserError("expected a notebook, found a link or a device")
    if file.stat().st_size > LARGEST:
        raise UserError(f"expected a notebook of at most {LARGEST >> 20} MB, found a larger file")
    try:
        notebook = nbformat.read(file, 4)
        cells = notebook.cells
        assert all(isinstance(c.source, str) and c.cell_type for c in cells)
        for cell in cells:
            cell.metadata = NotebookNode()  # Tags can tell a runner to skip a cell.
            if cell.cell_type == "code":
                cell.update(outputs=[], execution_count=None)
        nbformat.writes(notebook).encode()  # Half of a character can be read, but not written.
    except Exception as error:  # Whatever a student's file may hold.
        raise UserError(
            f"expected a notebook, found another file ({type(error).__name__})"
        ) from error
    return notebook
