"""Pages of the docs site that are made from the program and from its files, while it is built.

    command-line.md   ``--help`` of every command
    api.md            what ``import madviz`` offers, madviz.types and the examples
    results.md        results/RESULTS.md with its pictures
    tried.md          results/archive/tried.json: what was tried and did not help
    lessons.md        notebooks/README.md: the lessons, one by one
    audits/*.html     the audits of results/audits; along/*.html those along axes

architecture.md also gets the list of files, under its last heading. None of this is written to
docs/, so it cannot go stale there.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import audits
import package_tree
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import madviz
from benchmarks.__main__ import BENCHMARKS, PROGRAM
from madviz.commands import COMMANDS
from madviz.training.config import RECIPES, TrainConfig

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "results"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages above, and the pictures and the rates of the results."""
    pages = {
        "command-line.md": command_line(),
        "api.md": api(),
        "results.md": results(),
        "tried.md": tried(),
        "lessons.md": lessons(),
        **audits.pages(),
    }
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    for file in (RESULTS / "rates.csv", *sorted(RESULTS.glob("pictures/*.svg"))):
        name = file.relative_to(RESULTS).as_posix()
        files.append(File.generated(config, name, content=file.read_bytes()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Adds every file of the package to the page on the architecture, which ends with a heading for
    them."""
    if page.file.src_uri != "architecture.md":
        return markdown
    return f"{markdown.rstrip()}\n\n{package_tree.files()}"


PRINTS_HELP = """
import io, json, sys
from contextlib import redirect_stdout
from importlib import import_module

pages = []
for module, *words in json.load(sys.stdin):
    page = io.TextIOWrapper(io.BytesIO(), "utf-8")  # With an encoding: lines are drawn in boxes.
    with redirect_stdout(page):
        try:
            code = import_module(f"{module}.__main__").main([*words, "--help"])
        except SystemExit as ended:
            code = ended.code
    if code:
        sys.exit(f"{module} {words} --help ended with {code}")
    page.seek(0)
    pages.append(page.read())
json.dump(pages, sys.stdout)
"""
"""A program that reads a list of commands, and writes the list of their helps."""


def helps(commands: list[tuple[str, ...]]) -> dict[tuple[str, ...], str]:
    """The output of ``python -m COMMAND --help`` for each command, 100 columns wide and without
    colours. A process of its own has imported what the commands need only once."""
    environment = {**os.environ, "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    printed = subprocess.run(
        [sys.executable, "-c", PRINTS_HELP],
        input=json.dumps(commands),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env=environment,
        cwd=ROOT,
    )
    return dict(zip(commands, map(plain, json.loads(printed.stdout)), strict=True))


def plain(page: str) -> str:
    """A printed page without colours, without this folder's name, and without spaces at the end of
    its lines."""
    lines = re.sub(r"\x1b\[[0-9;]*m", "", page).replace(str(ROOT), ".").splitlines()
    return "\n".join(line.rstrip() for line in lines)


def command_line() -> str:
    """Markdown with the help of every command and of every benchmark."""
    recipes = [other for other in RECIPES if other != TrainConfig.recipe]
    page = helps(
        [
            ("madviz",),
            *(("madviz", name) for name in COMMANDS),
            *(("madviz", "train", "--recipe", recipe) for recipe in recipes),
            ("benchmarks",),
            *(("benchmarks", name) for name in BENCHMARKS),
        ]
    )
    parts = [
        "# Command line",
        "Made from `--help` when these pages are built, so the policies are those of the "
        "repository. `madviz --completion bash` prints a script for your shell; it completes "
        "commands, options and names. `--json FILE` writes a result as JSON; "
        "`--json -` prints it, and then nothing else goes to standard output. The exit code is 0 "
        "only for success, 2 for a mistake in the command, 1 for any other failure, 130 after "
        "Ctrl-C.",
        f"```text\n{page['madviz',]}\n```",
    ]
    for name in COMMANDS:
        parts.append(f"## madviz {name}\n\n```text\n{page['madviz', name]}\n```")
        if name == "train":
            for recipe in recipes:
                asked = page["madviz", "train", "--recipe", recipe]
                own = asked[
                    asked.index(f"╭─ {RECIPES[recipe].options.replace('_', '-')} options") :
                ]
                parts.append(f"### Options of the recipe {recipe}\n\n```text\n{own}\n```")
    usage = page["benchmarks",]
    parts.append(f"## Benchmarks\n\nFrom a clone of the repository.\n\n```text\n{usage}\n```")
    for name in BENCHMARKS:
        parts.append(f"### {PROGRAM} {name}\n\n```text\n{page['benchmarks', name]}\n```")
    return "\n\n".join(parts) + "\n"


def api() -> str:
    """Markdown that mkdocstrings fills with docstrings."""
    public = [f"::: {home}.{name}" for name, home in madviz.PUBLIC.items()]
    lines = [
        "# Python",
        "`import madviz` loads neither torch nor viser. These names load what they need when they "
        "are used:",
        *public,
        "## madviz.types",
        "::: madviz.types\n    options:\n      show_root_heading: false",
        "## Examples",
        "::: madviz.examples.own_policy",
        "::: madviz.examples.own_task",
    ]
    return "\n\n".join(lines) + "\n"


def results() -> str:
    """RESULTS.md; its pictures and its CSV file are beside the page."""
    text = (RESULTS / "RESULTS.md").read_text()
    return text.replace("[tried.json](archive/tried.json)", "[What was tried](tried.md)")


def lessons() -> str:
    """notebooks/README.md; the notebooks themselves are not in these pages."""
    text = (ROOT / "notebooks" / "README.md").read_text().replace("](../docs/", "](")
    return re.sub(r"\[([^\]]*)\]\(\w+\.ipynb\)", r"\1", text)


def tried() -> str:
    """The entries of results/archive/tried.json, a section for each task."""
    parts = [
        "# What was tried",
        "Changes to the light recipe that were measured, taken or not, by task, as they were "
        "written down then. Success rates are on development seeds.",
    ]
    for task, entries in json.loads((RESULTS / "archive" / "tried.json").read_text()).items():
        parts.append(f"## {task}\n")
        parts += [
            f"- {entry if isinstance(entry, str) else json.dumps(entry)}" for entry in entries
        ]
    return "\n\n".join(parts[:2]) + "\n\n" + "\n".join(parts[2:]) + "\n"
