"""axe-core, an engine that checks pages for people who do not see or do not use a mouse."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import Visitor
from tests.e2e.static_site import MAD, MERGED_ONLY, ROOT, fake_site, served

AXE = ROOT / ".venv/node/node_modules/axe-core/axe.min.js"
VISERS = "[class*='mantine-ActionIcon'], [class*='mantine-Slider'], [class*='mantine-NumberInput']"
"""Viser's own controls, which have no names: two buttons of its panel, sliders, their numbers."""


def faults(page: Any, without: str = "") -> list[str]:
    """Serious and critical faults, each with the element that has it."""
    page.evaluate(AXE.read_text())
    found = page.evaluate(
        "without => axe.run({exclude: without ? [[without]] : []}, {resultTypes: ['violations']})",
        without,
    )
    assert found["passes"], "it looked at something"
    return [
        f"{fault['id']}: {node['html'][:120]}"
        for fault in found["violations"]
        if fault["impact"] in ("serious", "critical")
        for node in fault["nodes"]
    ]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_the_site_has_no_serious_fault(browser, tmp_path: Path, width: int, scheme: str) -> None:
    with served(fake_site(tmp_path / "site")) as address:
        context = browser.new_context(
            viewport={"width": width, "height": 800}, color_scheme=scheme, reduced_motion="reduce"
        )
        page = context.new_page()
        for part in ("", f"#policy={MAD}&vs={MERGED_ONLY}"):
            page.goto("about:blank")
            page.goto(f"{address}{part}")
            page.wait_for_selector("body[data-ready]")
            page.locator("#line").filter(has_text="a").wait_for()
            assert faults(page) == []
        page.goto(f"{address}lesson.html")
        page.get_by_role("button", name="Show the robots").wait_for()
        assert faults(page) == []
        context.close()


def test_what_we_add_to_the_page_has_no_serious_fault(visitor: Visitor) -> None:
    visitor.press("pause")
    names = [tab.inner_text() for tab in visitor.page.get_by_role("tab").all()]
    found = {}
    for name in dict.fromkeys(filter(None, map(str.strip, names))):
        visitor.page.get_by_role("tab", name=name, exact=True).last.click()
        found |= {name: named} if (named := faults(visitor.page, VISERS)) else {}
    assert found == {}
