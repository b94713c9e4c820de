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
from benchmarks.__main__ import PROGRAM
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


def help_of(*command: str, module: str = "madviz") -> str:
    """The output of ``python -m MODULE COMMAND --help``, 100 columns wide and without colours."""
    environment = {**os.environ, "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    program = [sys.executable, "-m", module, *command, "--help"]
    printed = subprocess.run(
        program, capture_output=True, text=True, check=True, env=environment, cwd=ROOT
    )
    lines = re.sub(r"\x1b\[[0-9;]*m", "", printed.stdout).replace(str(ROOT), ".").splitlines()
    return "\n".join(line.rstrip() for line in lines)


def commands(usage: str) -> list[str]:
    """The names in a usage text: the first word of every line that is indented by two."""
    return re.findall(r"^  ([a-z]+)  ", usage, re.MULTILINE)


def command_line() -> str:
    """Markdown with the help of every command and of every benchmark."""
    whole = help_of()
    usage = help_of(module="benchmarks")
    parts = [
        "# Command line",
        "Made from `--help` when these pages are built, so the policies are those of the "
        "repository. `madviz --completion bash` prints a script for your shell; it completes "
        "commands, options and names. `--json FILE` writes a result as JSON; "
        "`--json -` prints it, and then nothing else goes to standard output. The exit code is 0 "
        "only for success, 2 for a mistake in the command, 1 for any other failure, 130 after "
        "Ctrl-C.",
        f"```text\n{whole}\n```",
    ]
    for name in commands(whole):
        described = help_of(name)
        parts.append(f"## madviz {name}\n\n```text\n{described}\n```")
        if name == "train":
            for recipe in [other for other in RECIPES if other != TrainConfig.recipe]:
                asked = help_of(name, "--recipe", recipe)
                own = asked[
                    asked.index(f"╭─ {RECIPES[recipe].options.replace('_', '-')} options") :
                ]
                parts.append(f"### Options of the recipe {recipe}\n\n```text\n{own}\n```")
    parts.append(f"## Benchmarks\n\nFrom a clone of the repository.\n\n```text\n{usage}\n```")
    for name in commands(usage):
        parts.append(f"### {PROGRAM} {name}\n\n```text\n{help_of(name, module='benchmarks')}\n```")
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
