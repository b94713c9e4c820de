"""Notebooks: the two halves of every pair agree, outputs are there and small, and they run.

All of them run under ``pytest -m slow``; here one does, and of the others everything is checked
that can be without a kernel.
"""

from __future__ import annotations

import ast
import importlib
import json
import re
import runpy
import tempfile
from html import unescape
from pathlib import Path
from typing import Any

import nbformat
import pytest

from madviz.teaching.checks import of_lesson

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


def test_there_is_a_notebook_for_every_text() -> None:
    assert [int(name[:2]) for name in NAMES] == list(range(10))
    assert sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_text_and_notebook_agree(name: str) -> None:
    text, notebook = BUILD["from_text"](name), saved(name)
    mine = [(cell.cell_type, cell.source, cell.id, cell.metadata) for cell in text.cells]
    theirs = [(cell.cell_type, cell.source, cell.id, cell.metadata) for cell in notebook.cells]
    assert mine == theirs, "run: python notebooks/build.py --text"


@pytest.mark.parametrize("name", NAMES)
def test_every_cell_was_run_and_none_failed(name: str) -> None:
    cells = [cell for cell in saved(name).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert all(output.output_type != "error" for output in outputs)
    assert all(output.get("name") != "stderr" for output in outputs)


@pytest.mark.parametrize("name", NAMES)
def test_widgets_have_html_where_there_is_no_kernel(name: str) -> None:
    notebook = saved(name)
    shown = [output.data for cell in notebook.cells for output in cell.get("outputs", [])
             if "data" in output]  # fmt: skip
    widgets = [data for data in shown if "application/vnd.jupyter.widget-view+json" in data]
    assert widgets and all(len(data["text/html"]) > 50 for data in widgets)
    assert str(ROOT) not in json.dumps(notebook), "a path of the machine that built it"


KEY = re.compile(r"""(?<![\w#&='"])(?:third_[a-z]|first[+.]\w)""")
"""A camera's key where no code is: in quotes, or in a link, it is one that a student writes."""


def read(output: nbformat.NotebookNode) -> list[str]:
    """The texts of an output that a person reads; Markdown has code."""
    data = output.get("data", {"text/plain": output.get("text", "")})
    texts = [] if "text/markdown" in data else map(str, data.values())
    return [re.sub(r"base64,[\w+/=]+", "", unescape(text)) for text in texts]


@pytest.mark.parametrize("name", NAMES)
def test_no_output_has_the_key_of_a_camera(name: str) -> None:
    outputs = [output for cell in saved(name).cells for output in cell.get("outputs", [])]
    found = [
        text[max(key.start() - 30, 0) : key.end() + 30]
        for output in outputs
        for text in read(output)
        for key in KEY.finditer(text)
    ]
    assert not found, "say teaching.named(key)"


def test_the_folder_is_small() -> None:
    sizes = {p.name: p.stat().st_size / 1024 for p in NOTEBOOKS.rglob("*") if p.is_file()}
    own = {name: size for name, size in sizes.items() if name.endswith((".ipynb", ".py", ".md"))}
    assert sum(own.values()) < KILOBYTES, own


@pytest.mark.parametrize("name", NAMES)
def test_a_lesson_has_all_its_parts(name: str) -> None:
    words = prose(name)
    assert words.startswith(f"# {int(name[:2])}. ") and "**Question:" in words
    assert words.count("## Exercise") == len(of_lesson(name)) > 0
    assert "Predict(" in code(name) and "in_words(" in code(name)
    assert "Explorer(" in code(name) or "TryOut(" in code(name)


@pytest.mark.parametrize("file", sorted(NOTEBOOKS.glob("text/*.py")), ids=lambda file: file.stem)
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


@pytest.mark.parametrize("name", NAMES)
def test_code_that_a_lesson_shows_is_the_code_that_ships(name: str) -> None:
    cells = {cell.source: cell for cell in saved(name).cells if cell.cell_type == "code"}
    for text, code in BUILD["shown_code"](BUILD["from_text"](name)).items():
        now = repr(code)
        assert cells[text].outputs[0].data["text/plain"] == now, "run: notebooks/build.py --text"


def test_old_code_in_a_lesson_is_replaced() -> None:
    notebook = saved(QUICK)
    cell = next(cell for cell in notebook.cells if cell.source.startswith("source("))
    before = dict(cell.outputs[0].data)
    cell.outputs[0].data = {"text/plain": "def old(): ...", "text/markdown": ""}
    BUILD["refresh_code"](notebook)
    assert dict(cell.outputs[0].data) == before


def test_the_teacher_finds_every_lesson() -> None:
    page = (NOTEBOOKS / "README.md").read_text()
    assert all(f"{name}.ipynb" in page for name in NAMES)


def test_unchanged_cells_keep_their_outputs() -> None:
    text, before = BUILD["from_text"](QUICK), saved(QUICK)
    text.cells[3].source = "1 + 1"
    BUILD["keep_outputs"](text, before)
    cells = [cell.get("outputs") for cell in text.cells]
    assert cells[3] in (None, []) and cells[4:] == [c.get("outputs") for c in before.cells[4:]]


def test_a_notebook_runs_from_top_to_bottom() -> None:
    """Every cell of it, with a policy and a world that need no simulator."""
    text = BUILD["from_text"](QUICK)
    for cell in text.cells:
        cell.source = cell.source.replace(SHIPPED, "tests.fakes:FakePolicy")
    done = BUILD["run"](text)
    counts = [cell.execution_count for cell in done.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))


TINY = (
    "light.LightConfig(rounds=1, demonstrations=1, episodes_per_round=1, updates_per_round=2, "
    "batch_size=4, hidden_dim=16, critic_updates=0), 2"
)


def hammer_cells() -> list[str]:
    """What lesson 3 says about hammer, and the two cells that it needs from before."""
    cells = [cell for cell in BUILD["from_text"]("03_disentangle").cells]
    words = [cell.source for cell in cells]
    begin, end = (
        next(i for i, text in enumerate(words) if heading in text)
        for heading in ("## Is it the same on a real robot task?", "## Exercise 1")
    )
    chosen = [cell for cell in cells[begin:end] if cell.cell_type == "code"]
    before = ("import madviz", "streams =")
    return [text for text in words if text.startswith(before)] + [cell.source for cell in chosen]


def ran(cells: list[str]) -> tuple[dict[str, Any], list[Any]]:
    """Runs cells in this process: their names, and what each one shows."""
    names: dict[str, Any] = {}
    shown = []
    for cell in cells:
        *body, last = ast.parse(cell).body
        exec(compile(ast.Module(body, []), "cell", "exec"), names)
        if isinstance(last, ast.Expr):
            shown.append(eval(compile(ast.Expression(last.value), "cell", "eval"), names))
        else:
            exec(compile(ast.Module([last], []), "cell", "exec"), names)
    return names, shown


def test_the_hammer_switch_trains_takes_cameras_away_and_compares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own cells, with a budget of seconds, and the toy in the place of the simulator."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    text = "\n<<>>\n".join(hammer_cells())
    for asked, instead in (
        ("HAMMER = False", "HAMMER = True"),
        ("evaluate(own.folder", "evaluate(own.policy"),  # In this process: nothing to start.
        ('"metaworld/hammer", light.LightConfig(rounds=20), 20', f'"toy/reach", {TINY}'),
    ):
        assert text.count(asked) == 1
        text = text.replace(asked, instead)
    names, shown = ran(text.split("\n<<>>\n"))
    own = names["own"]
    try:
        assert own.folder.is_relative_to(tmp_path) and own.spec.task == "toy/reach"
        assert (own.spec.method, names["hammer_explorer"].frame.world.policy.name) == (
            "mad",
            own.spec.name,
        )
        counted = names["hammer"]["mad, trained here"]
        assert {name: n for name, (_, n) in counted.items()} == dict.fromkeys(
            ("all", "first", "third_a", "third_b"), 2
        )
        compared = next(
            one for one in shown if getattr(one, "head", ())[-1:] == ("mad - merged-only",)
        )
        assert [row[0] for row in compared.rows] == ["First person", "Third A", "Third B"]
        assert all(row[-1].endswith("n=2") for row in compared.rows), "the same two scenes"
    finally:
        names["hammer_explorer"].close()


def test_the_time_of_the_hammer_training_is_the_one_on_its_card() -> None:
    training = json.loads(
        (ROOT / "checkpoints" / SHIPPED / "config.json").read_text(encoding="utf-8")
    )["training"]
    assert "--light.rounds 20 " in training["command"], "as lesson 3 trains it"
    minutes = f"{training['wall_time_s'] / 60:.0f} minutes"
    assert prose("03_disentangle").count(minutes) == code("03_disentangle").count(minutes) == 1
    assert minutes in (NOTEBOOKS / "README.md").read_text()


def test_without_the_switch_nothing_is_trained_on_hammer() -> None:
    names, shown = ran(hammer_cells())
    assert names["own"] is None and names["hammer_explorer"] is None
    assert set(names["hammer"]) == {"mad", "merged-only"}
    assert "n=100" in repr(shown[-2])


@pytest.mark.parametrize("name", NAMES)
def test_no_cell_closes_a_widget(name: str) -> None:
    """A cell that closes its widget leaves the reader nothing to use."""
    cells = BUILD["from_text"](name).cells
    code = [c.source.replace("env.close()", "") for c in cells if c.cell_type == "code"]
    assert not [text for text in code if ".close()" in text]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_notebook_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # Trainings are new ones.
    done = BUILD["run"](BUILD["from_text"](name))
    assert all(cell.execution_count for cell in done.cells if cell.cell_type == "code")
