"""README and docs: their figures are those in the files, their commands work, their links lead
somewhere, and a built page fetches nothing from elsewhere."""

from __future__ import annotations

import importlib
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from benchmarks.__main__ import BENCHMARKS, PROGRAM
from madviz import cli
from madviz.report.threshold import TWENTY
from madviz.system.typed import typed

ROOT = Path(__file__).resolve().parent.parent
PAGES = (ROOT / "README.md", ROOT / "environment.md", *sorted((ROOT / "docs").glob("*.md")))
FENCE = re.compile(r"(?:<!-- ([^\n]*) -->\n *)?```sh\n(.*?)```", re.DOTALL)
"""A block of commands and the mark above it: ``slow``, or ``not run: REASON``."""


class Written(NamedTuple):
    """A command in a page, and the mark above its block."""

    page: str
    line: str
    mark: str


def commands() -> Iterator[Written]:
    for page in PAGES:
        for mark, block in FENCE.findall(page.read_text()):
            for line in block.replace("\\\n", " ").splitlines():
                line = re.sub(r"\s+#\s.*", "", line).strip()
                if line and not line.startswith("#"):
                    yield Written(page.name, line, mark)


TABLES = {"madviz": cli.COMMANDS, "benchmarks": BENCHMARKS}
"""The commands of each module that is run here."""


def of_ours(line: str) -> tuple[str, list[str]]:
    """The module that a command runs, a key of ``TABLES``, and the words after it; '' for another
    program."""
    words = shlex.split(line)
    while words and "=" in words[0]:
        del words[0]
    if words and words[0] == "madviz":
        return "madviz", words[1:]
    return ("benchmarks", words[3:]) if words[:3] == PROGRAM.split() else ("", [])


OURS = [each for each in commands() if of_ours(each.line)[0]]


READ_FIRST = ("README.md", "docs/index.md", "docs/cookbook.md", "docs/page.md", "docs/audit.md")
"""Pages that people read before they know the words; their sentences are short."""
LONGEST = 28
"""Words of a sentence there."""


def sentences(text: str) -> Iterator[str]:
    """The prose of a page: no code, tables, headings or comments, and links by their text."""
    text = re.sub(r"```.*?```|<!--.*?-->", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`", "code", text)
    lines = [line for line in text.splitlines() if not re.match(r"\s*(\||#)", line)]
    for part in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.)\s", "\n".join(lines)):
        yield from re.split(r"(?<=[.?!])\**\s+", " ".join(part.split()))


def test_readme_is_read_in_one_sitting() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 120
    prose = " ".join(sentences(text))
    assert len(re.findall(r"\d+(?:\.\d+)?", prose)) <= 60


@pytest.mark.parametrize("page", READ_FIRST)
def test_sentences_of_a_first_page_are_short(page: str) -> None:
    long = [one for one in sentences((ROOT / page).read_text()) if len(one.split()) > LONGEST]
    assert long == []


def test_figures_in_the_text_are_those_in_the_files() -> None:
    command = [sys.executable, str(ROOT / "tools" / "fill_figures.py"), "--check"]
    checked = subprocess.run(command, capture_output=True, text=True)
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_a_block_of_figures_without_an_end_takes_no_text(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    fill = importlib.import_module("fill_figures").filled
    block = "<!-- figures: machine2 -->\n"
    with pytest.raises(ValueError, match="found one without"):
        fill(f"{block}important\n<!-- figures: packages -->\n<!-- end -->\n")
    with pytest.raises(KeyError, match="machine2"):
        fill(f"{block}<!-- end -->\n")


def test_files_that_the_architecture_names_are_there() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    named = re.findall(r"`([a-z_/]+\.(?:py|js))`", text)
    places = (ROOT, ROOT / "madviz")
    missing = [name for name in named if not any((place / name).is_file() for place in places)]
    assert len(named) > 20 and missing == []


def test_pictures_of_the_page_are_all_shown_and_small() -> None:
    pictures = sorted((ROOT / "docs" / "panels").glob("*.png"))
    shown = re.findall(r"\]\((panels/.*?\.png)\)", (ROOT / "docs" / "page.md").read_text())
    assert sorted(shown) == [f"panels/{file.name}" for file in pictures]
    assert sum(file.stat().st_size for file in pictures) < 1_000_000


def test_what_was_tried_is_said_of_tasks() -> None:
    file = ROOT / "results" / "archive" / "tried.json"
    found = typed(json.loads(file.read_text()), dict[str, list[str]], file, "")
    assert found.keys() <= set(TWENTY)


@pytest.mark.parametrize("written", OURS, ids=[f"{c.page}: {c.line}" for c in OURS])
def test_a_command_in_the_text_can_be_read(written: Written) -> None:
    """Also those that are not run: every command and option exists."""
    module, (name, *words) = of_ours(written.line)
    if name.startswith("-") or "--help" in words:
        return
    cli.parse(name, words, TABLES[module])


def test_what_is_not_run_says_why() -> None:
    for written in commands():
        assert re.fullmatch(r"(|slow|not run: .{6,})", written.mark), written
        if not of_ours(written.line)[0]:
            assert written.mark.startswith("not run: "), f"{written}: this program is not run here"


def runs(written: Written, folder: Path) -> None:
    """Runs a command as a reader would, in a folder of their own."""
    if not (folder / "checkpoints").exists():
        (folder / "checkpoints").symlink_to(ROOT / "checkpoints")
        (folder / "results").symlink_to(ROOT / "results")
    module, words = of_ours(written.line)
    line = [sys.executable, "-m", module, *words]
    path = os.pathsep.join([str(ROOT), str(folder)])
    done = subprocess.run(
        line, cwd=folder, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}
    )
    assert done.returncode == 0, f"{written.line}\n{done.stdout}{done.stderr}"


QUICK: dict[str, list[Written]] = {}
"""The commands that are run every time, by their line: some stand in several pages."""
for each in OURS:
    if not each.mark:
        QUICK.setdefault(each.line, []).append(each)
SLOW = {page.name: [c for c in OURS if c.page == page.name] for page in PAGES}


@pytest.mark.parametrize(
    "written",
    [same[0] for same in QUICK.values()],
    ids=[f"{', '.join(c.page for c in same)}: {line}" for line, same in QUICK.items()],
)
def test_a_quick_command_in_the_text_works(written: Written, tmp_path: Path) -> None:
    runs(written, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("page", SLOW)
def test_the_commands_of_a_page_work_one_after_the_other(page: str, tmp_path: Path) -> None:
    for written in SLOW[page]:
        if not written.mark.startswith("not run: "):
            runs(written, tmp_path)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The docs as they are built for readers; MkDocs stops at a link that leads nowhere."""
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert built.returncode == 0, built.stdout + built.stderr
    return out


def test_a_built_page_fetches_nothing_from_elsewhere(site: Path) -> None:
    for page in site.glob("*.html"):
        fetched = re.findall(
            r"<(?:script|img|link|iframe|source)[^>]*(?:src|href)=[\"'](https?://[^\"']+)",
            page.read_text(),
        )
        assert [url for url in fetched if "canonical" not in url] == [], page.name


def headings(page: Path) -> set[str]:
    """The anchors of a page's headings, as MkDocs and Git hosts make them."""
    found = re.findall(r"^#+ (.*)", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).lower().replace(" ", "-") for heading in found}


LINKED = (*PAGES, *ROOT.glob("*/README.md"), *ROOT.glob("results/*.md"))


@pytest.mark.parametrize("page", LINKED, ids=lambda page: f"{page.parent.name}/{page.name}")
def test_links_of_the_repository_lead_somewhere(page: Path) -> None:
    for target, anchor in re.findall(
        r"\]\((?!https?:|mailto:)([^)#\s]*)#?([^)\s]*)\)", page.read_text()
    ):
        if target in ("api.md", "command-line.md", "lessons.md", "results.md", "tried.md"):
            continue
        if target.startswith(("audits/", "along/")):
            assert (ROOT / "results" / target).with_suffix(".json").exists(), target
            continue
        linked = page.parent / target if target else page
        assert linked.exists(), target
        assert not anchor or anchor in headings(linked), f"{target}#{anchor}"


def test_links_of_the_static_site_lead_somewhere() -> None:
    web = ROOT / "madviz" / "site" / "web"
    for page in web.glob("*.html"):
        for target in re.findall(r"(?:href|src)=\"(?!https?:|data:|#)([^\"#?]+)", page.read_text()):
            assert target in ("./", "licences.txt") or (web / target).exists(), target
