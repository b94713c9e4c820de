"""One word for one thing: on page and site, in lessons, audit and film, in the glossary."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from madviz.app.markup import term
from madviz.vocabulary.words import MEANINGS, SHOWN, shown_meanings

ROOT = Path(__file__).resolve().parent.parent
SECOND_WORDS = {
    "state only": "no camera",
    "shipped": "measured",
    "measured here": "counted here",
    "dropout": "lossy",
    "set of cameras": "subset",
    "differs by": "apart",
    "unlink": "switches act on",
}
"""Words that visitors met beside the one that stays. Commands and keys of JSON keep theirs."""
NAMES = re.compile(r"^[\w.:{}/-]*$")
"""A key, a name or a path, which no visitor reads."""


def strings(path: Path) -> list[str]:
    """The texts of a Python file that are not docstrings or names."""
    tree = ast.parse(path.read_text())
    docs = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    return [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs
    ]


def shown_texts() -> dict[str, list[str]]:
    """By file, the texts of page, audit, film, widgets and site."""
    page = {
        str(p.relative_to(ROOT)): strings(p)
        for folder in ("app", "measure/audit", "recording", "drawing", "session", "widgets")
        for p in (ROOT / "madviz" / folder).rglob("*.py")
    }
    quoted = re.compile(r"'([^'\n]*)'|`([^`]*)`")
    site = {
        str(p.relative_to(ROOT)): [a or b for a, b in quoted.findall(without_comments(p))]
        for p in (ROOT / "madviz" / "site" / "web").glob("*.js")
    }
    return page | site


def lesson_texts() -> dict[str, list[str]]:
    """By lesson, its lines of text. Policies are *shipped* there: they come with madviz."""
    lines = {
        str(p.relative_to(ROOT)): [
            line[1:] for line in p.read_text().splitlines() if line.startswith("#")
        ]
        for p in (ROOT / "notebooks" / "text").glob("*.py")
    }
    page = ROOT / "madviz" / "site" / "web" / "lesson.html"
    return {**lines, str(page.relative_to(ROOT)): page.read_text().splitlines()}


def without_comments(path: Path) -> str:
    return re.sub(r"/\*.*?\*/|//[^\n]*", "", path.read_text(), flags=re.DOTALL)


@pytest.mark.parametrize("word", SECOND_WORDS)
def test_nothing_that_is_read_has_a_second_word(word: str) -> None:
    pattern = re.compile(rf"\b{re.escape(word)}s?\b")
    everything = shown_texts() | (lesson_texts() if word != "shipped" else {})
    found = [
        f"{file}: {text[:80]!r}"
        for file, texts in everything.items()
        for text in texts
        if pattern.search(text) and not NAMES.match(text)
    ]
    assert not found, f"say {SECOND_WORDS[word]!r}"


def test_words_of_headings_are_plain_text() -> None:
    assert set(SHOWN) <= set(MEANINGS)
    for says in shown_meanings().values():
        assert not re.search(r"[`*\[\]<>]", says)
        assert len(says) <= 130


def test_a_term_says_what_it_means_without_a_pointer() -> None:
    html = term("norm", "Norm <b>")
    assert 'tabindex="0"' in html and MEANINGS["norm"] in html and "Norm &lt;b&gt;" in html
    with pytest.raises(KeyError):
        term("wurst")


def test_the_glossary_has_every_word() -> None:
    text = (ROOT / "docs" / "concepts.md").read_text()
    assert all(f"| {word} |" in text for word in MEANINGS)
