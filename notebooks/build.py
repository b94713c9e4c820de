"""Makes NAME.ipynb from text/NAME.py: runs every cell and saves the outputs.

    python notebooks/build.py            all of them, some minutes
    python notebooks/build.py 02 04      those that begin so
    python notebooks/build.py --text     no runs: new cells go in, outputs of unchanged ones stay,
                                         and cells that show code show today's

The text is what is edited and what a difference shows; the notebook is what a class opens. Cells
get names that only depend on their place, and times of execution are left out, so that a second
build changes nothing but what was measured anew.
"""

from __future__ import annotations

import ast
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).resolve().parent
MINUTES = 20
"""A cell that takes longer hangs; a busy machine is slow."""


def names(words: list[str]) -> list[str]:
    """The notebooks that begin with one of ``words``; all where there are none."""
    known = sorted(path.stem for path in (HERE / "text").glob("*.py"))
    return [name for name in known if not words or name.startswith(tuple(words))]


def from_text(name: str) -> nbformat.NotebookNode:
    """The notebook of text/NAME.py, with names for its cells and no outputs."""
    notebook = jupytext.read(HERE / "text" / f"{name}.py")
    for index, cell in enumerate(notebook.cells):
        cell["id"] = f"{name[:2]}-{index:02d}"
        keep_tags(cell)
    notebook.metadata = {"kernelspec": notebook.metadata["kernelspec"]}
    return notebook


def keep_tags(cell: nbformat.NotebookNode) -> None:
    """Leaves a cell its tags and nothing else; a solution is folded until somebody opens it."""
    tags = cell.metadata.get("tags", [])
    cell.metadata = nbformat.from_dict({"tags": tags} if tags else {})
    if "solution" in tags:
        cell.metadata["jupyter"] = {"source_hidden": True}


def run(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Executes it in the folder of the notebooks, as JupyterLab does, with this tree's package. The
    folder for temporary files is empty: lessons save trainings there and do not repeat them."""
    paths = os.pathsep.join(filter(None, [str(HERE.parent), os.environ.get("PYTHONPATH", "")]))
    client = NotebookClient(
        notebook, timeout=60 * MINUTES, resources={"metadata": {"path": str(HERE)}}
    )
    with tempfile.TemporaryDirectory() as fresh:
        return client.execute(env={**os.environ, "PYTHONPATH": paths, "TMPDIR": fresh})


def tidy(notebook: nbformat.NotebookNode) -> None:
    """Leaves out what differs between two builds for no reason, and joins printed lines."""
    for cell in notebook.cells:
        keep_tags(cell)
        outputs, printed = [], {}
        for output in cell.get("outputs", []):
            if output.output_type != "stream":
                outputs.append(output)
            elif output.name == "stdout":
                if "stdout" in printed:
                    printed["stdout"].text += output.text
                else:
                    printed["stdout"] = output
                    outputs.append(output)
        if "outputs" in cell:
            cell.outputs = outputs
    notebook.metadata.pop("language_info", None)


def keep_outputs(notebook: nbformat.NotebookNode, before: nbformat.NotebookNode) -> None:
    """Takes the outputs of cells whose text has not changed from ``before``."""
    old = {cell.source: cell for cell in before.cells if cell.cell_type == "code"}
    for cell in notebook.cells:
        if cell.cell_type == "code" and cell.source in old:
            cell.outputs = old[cell.source].outputs
            cell.execution_count = old[cell.source].execution_count
    if "widgets" in before.metadata:
        notebook.metadata["widgets"] = before.metadata["widgets"]


def shown_code(notebook: nbformat.NotebookNode) -> dict[str, Any]:
    """The cells that show the package's code, by their text, and what they would show now."""
    cells = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    imports = (ast.Import, ast.ImportFrom)
    body = ast.parse(cells[0]).body
    first: list[ast.stmt] = [node for node in body if isinstance(node, imports)]
    names: dict[str, Any] = {}
    exec(compile(ast.Module(first, []), "imports", "exec"), names)
    return {text: eval(text, names) for text in cells if text.startswith("source(")}


def refresh_code(notebook: nbformat.NotebookNode) -> None:
    """Puts today's code into the cells that show code and nothing else."""
    shown = shown_code(notebook)
    for cell in notebook.cells:
        if cell.cell_type == "code" and cell.source in shown and cell.get("outputs"):
            code = shown[cell.source]
            data = {"text/markdown": code._repr_markdown_(), "text/plain": repr(code)}
            cell.outputs[0].data = nbformat.from_dict(data)


def main(words: list[str]) -> None:
    text_only = "--text" in words
    for name in names([word for word in words if word != "--text"]):
        notebook, file = from_text(name), HERE / f"{name}.ipynb"
        began, busy = time.monotonic(), processors()
        if not text_only:
            run(notebook)
            tidy(notebook)
        elif file.exists():
            keep_outputs(notebook, nbformat.read(file, 4))
            refresh_code(notebook)
        nbformat.write(notebook, file)
        took, busy = time.monotonic() - began, processors() - busy
        size = file.stat().st_size / 1024
        print(f"{name}: {took:.0f} s, {busy:.0f} s of one core, {size:.0f} kB", flush=True)


def processors() -> float:
    """Seconds of processor time of all kernels that have ended; on a machine that is busy with
    other work it says more than the clock."""
    times = os.times()
    return times.children_user + times.children_system


if __name__ == "__main__":
    main(sys.argv[1:])
