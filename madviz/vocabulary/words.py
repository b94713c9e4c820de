"""The words of madviz, each with one sentence: one word for one thing.

``meanings.toml`` has them. The page shows the sentence of a word in a heading, a static site has
the same words in its manifest, and the glossary of the documentation is made of all of them.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

MEANINGS: dict[str, str] = tomllib.loads(
    Path(__file__).with_name("meanings.toml").read_text(encoding="utf-8")
)
"""By word; the sentence is Markdown, and plain text for ``SHOWN``."""
SHOWN = (
    "action",
    "apart",
    "cosine",
    "counted here",
    "measured",
    "merged feature",
    "norm",
    "not trained on",
    "Q",
    "share",
    "Shapley value",
    "success",
)
"""The words that page and site explain where they stand in a heading."""


def shown_meanings() -> dict[str, str]:
    """The sentences of ``SHOWN``."""
    return {word: MEANINGS[word] for word in SHOWN}
