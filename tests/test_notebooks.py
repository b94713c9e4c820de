"""Notebooks: the two halves of every pair agree, outputs are there and small, and they run.

All of them run under ``pytest -m slow``; here one does, and of the others everything is checked
that can be without a kernel.
"""

from __future__ import annotations

import ast
import importlib
import json
import runpy
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "notebooks"
BUILD = runpy.run_path(str(NOTEBOOKS / "build.py"))
NAMES: list[str] = BUILD["names"]([])
QUICK, SHIPPED = "02_merge", "metaworld-hammer-mad-light"
LINES, KILOBYTES = 6, 3 * 1024
"""Of a function that may live in a notebook; of the whole folder."""


def saved(name: str) -> nbformat.NotebookNode:
    return nbformat.read(NOTEBOOKS / f"{name}.ipynb", 4)


def code(name: str) -> str:
    """All Python of a notebook's text."""
    cells = BUILD["from_text"](name).cells
    return "\n".join(cell.source for cell in cells if cell.cell_type == "code")


def prose(name: str) -> str:
    cells = BUILD["from_text"](name).cells
    return "\n".join(cell.source for cell in cells if cell.cell_type == "markdown")


def test_there_is_a_notebook_for_every_text_and_a_solution_for_every_exercise() -> None:
    assert len(NAMES) >= 7
    assert sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb")) == NAMES
    assert sorted(path.stem for path in (NOTEBOOKS / "solutions").glob("*.py")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_text_and_notebook_agree(name: str) -> None:
    text, notebook = BUILD["from_text"](name), saved(name)
    mine = [(cell.cell_type, cell.source, cell.id) for cell in text.cells]
    theirs = [(cell.cell_type, cell.source, cell.id) for cell in notebook.cells]
    assert mine == theirs, "run: python notebooks/build.py --text"


@pytest.mark.parametrize("name", NAMES)
def test_every_cell_was_run_and_none_failed(name: str) -> None:
    cells = [cell for cell in saved(name).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert all(output.output_type != "error" for output in outputs)
    assert all(output.get("name") != "stderr" for output in outputs)


@pytest.mark.parametrize("name", NAMES)
def test_it_reads_well_where_it_is_only_shown(name: str) -> None:
    notebook = saved(name)
    shown = [output.data for cell in notebook.cells for output in cell.get("outputs", [])
             if "data" in output]  # fmt: skip
    widgets = [data for data in shown if "application/vnd.jupyter.widget-view+json" in data]
    assert widgets and all(len(data["text/html"]) > 50 for data in widgets)
    assert str(ROOT) not in json.dumps(notebook), "a path of the machine that built it"


def test_the_folder_is_small() -> None:
    sizes = {p.name: p.stat().st_size / 1024 for p in NOTEBOOKS.rglob("*") if p.is_file()}
    own = {name: size for name, size in sizes.items() if name.endswith((".ipynb", ".py", ".md"))}
    assert sum(own.values()) < KILOBYTES, own


@pytest.mark.parametrize("name", NAMES)
def test_a_lesson_has_all_its_parts(name: str) -> None:
    words = prose(name)
    assert words.startswith(f"# {int(name[:2])}. ") and "**Question:" in words
    assert "## Exercise" in words and f"`solutions/{name}.py`" in words
    assert "Predict(" in code(name) and "in_words(" in code(name)
    assert "Explorer(" in code(name) or "TryOut(" in code(name)


@pytest.mark.parametrize("file", [*NOTEBOOKS.glob("text/*.py"), *NOTEBOOKS.glob("solutions/*.py")],
                         ids=lambda file: f"{file.parent.name}-{file.stem}")  # fmt: skip
def test_what_it_imports_is_there_and_functions_are_short(file: Path) -> None:
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom):
            module = importlib.import_module(node.module or "")
            for alias in node.names:
                found = hasattr(module, alias.name)
                assert found or importlib.import_module(f"{node.module}.{alias.name}")
        elif isinstance(node, ast.Import):
            for alias in node.names:
                importlib.import_module(alias.name)
        elif isinstance(node, ast.FunctionDef):
            assert (node.end_lineno or 0) - node.lineno < LINES, f"{node.name} belongs in madviz"


def test_the_teacher_finds_every_lesson() -> None:
    page = (NOTEBOOKS / "README.md").read_text()
    assert all(f"{name}.ipynb" in page and f"solutions/{name}.py" in page for name in NAMES)


def test_unchanged_cells_keep_their_outputs() -> None:
    text, before = BUILD["from_text"](QUICK), saved(QUICK)
    text.cells[3].source = "1 + 1"
    BUILD["keep_outputs"](text, before)
    kept = [cell.get("outputs") for cell in text.cells]
    assert kept[3] in (None, []) and kept[4:] == [c.get("outputs") for c in before.cells[4:]]


def test_a_notebook_runs_from_top_to_bottom() -> None:
    """Every cell of it, with a policy and a world that need no simulator."""
    text = BUILD["from_text"](QUICK)
    for cell in text.cells:
        cell.source = cell.source.replace(SHIPPED, "tests.fakes:FakePolicy")
    done = BUILD["run"](text)
    counts = [cell.execution_count for cell in done.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_notebook_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # Trainings are new ones.
    done = BUILD["run"](BUILD["from_text"](name))
    assert all(cell.execution_count for cell in done.cells if cell.cell_type == "code")


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_solution_runs(name: str) -> None:
    runpy.run_path(str(NOTEBOOKS / "solutions" / f"{name}.py"), run_name="__main__")
