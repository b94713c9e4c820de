"""The static site's page in a real Chromium, on a fake worker: what a visitor sees and does."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.static_site import (
    FILE,
    MAD,
    MERGED_ONLY,
    NO_WEBGL,
    fake_site,
    manifest,
    served,
    until,
)

PATIENCE = 30_000
LINK = f"#policy={MAD}&vs={MERGED_ONLY}&seed=5001&third_a=off@4"


@pytest.fixture(scope="module")
def address(tmp_path_factory) -> Iterator[str]:
    """Of the page in a folder below the host's root."""
    folder = tmp_path_factory.mktemp("site")
    fake_site(folder / "below")
    with served(folder) as url:
        yield f"{url}below/"


@pytest.fixture
def visit(browser) -> Iterator[Callable[..., Any]]:
    """Opens a page and waits until it plays; its errors fail the test."""
    contexts, errors = [], []

    def visit(url: str, ready: bool = True, script: str = "", **options: Any) -> Any:
        options = {"viewport": {"width": 1280, "height": 800}} | options
        contexts.append(browser.new_context(**options))
        page = contexts[-1].new_page()
        page.set_default_timeout(PATIENCE)
        page.on("pageerror", lambda error: errors.append(str(error)))
        if script:
            page.add_init_script(script)
        page.goto(url)
        if ready:
            page.wait_for_selector("body[data-ready]")
        return page

    yield visit
    for context in contexts:
        context.close()
    assert errors == []


def tags(page: Any, camera: str) -> list[str]:
    """What stands in the corner of a camera's pictures, side by side."""
    return page.locator(f".view[data-camera={camera}] .tagged").all_inner_texts()


def switch(page: Any, camera: str, value: str, board: int = 0) -> None:
    """Sets a camera's switch, as a click on its word does."""
    card = page.locator(".board").nth(board).locator(f"[data-camera={camera}]")
    card.locator(f"label:has(input[value={value}])").click()


def test_the_opening_tells_what_happens_and_hands_over_the_switches(visit, address):
    page = visit(address)
    assert page.locator(".side").count() == 2
    until(page, "Which policy will still do it?", "#line")
    page.get_by_role("button", name="both").click()
    until(page, "Step 15: First person is off.", "#line")
    assert tags(page, "first") == ["off", "off"]
    words = until(page, "MAD drove the nail in, Merged Only did not.", "#line")
    assert "First person was dropped at step 15." in words
    assert "You said both, and it was MAD alone." in words
    assert "over 100 episodes: MAD 1.00 [0.96, 1.00] and Merged Only 0.00 [0.00, 0.04]." in words
    page.get_by_role("button", name="Your turn").click()
    until(page, "Cameras", "#controls")
    page.wait_for_function("() => !document.querySelector('.view.off')")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Iterator[str]:
    """A site whose policies have guards."""
    policies = [one | {"guard": FILE, "guarded_digest": "1" * 64} for one in manifest()["policies"]]
    with served(fake_site(tmp_path_factory.mktemp("fitted"), policies=policies)) as url:
        yield url


@pytest.mark.parametrize("width", [1280, 390])
def test_the_opening_has_three_acts_where_a_guard_is_fitted(visit, fitted, width: int):
    page = visit(fitted, viewport={"width": width, "height": 800})
    until(page, "MAD and Merged Only both drove the nail in.", "#line")
    page.get_by_role("button", name="Next: First person goes black").click()
    until(page, "Which policy will still do it?", "#line")
    page.get_by_role("button", name="MAD", exact=True).click()
    words = until(page, "Neither MAD nor Merged Only drove the nail in.", "#line")
    assert "You said MAD, and it was neither." in words
    assert tags(page, "first") == ["black", "black"]
    page.get_by_role("button", name="Next: the same with the guard").click()
    until(
        page, "Guard: First person sends black since step 15 (an even picture): left out.", "#line"
    )
    assert tags(page, "first") == ["BLACK · left out since step 15"] * 2
    until(page, "MAD drove the nail in, Merged Only did not.", "#line")
    assert page.locator(".view canvas.out").count() == 2
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.get_by_role("button", name="Your turn").click()
    page.wait_for_function("() => !document.querySelector('.guard input').checked")


def test_one_switch_is_the_guard(visit, fitted, address):
    page = visit(fitted + LINK.replace("third_a=off@4", "third_a=black@2"))
    page.get_by_label("Guard").click()
    until(page, "Guard: Third A sends black since step 2", "#line")
    until(page, "with guard · all cameras · third_a:black", "#inside")
    page.wait_for_function("() => location.hash.includes('guard=on')")
    link = page.evaluate("location.hash")
    again = visit(fitted + link)
    again.wait_for_function("() => document.querySelector('.guard input').checked")
    without = visit(address + LINK)
    assert without.get_by_label("Guard").is_disabled()
    assert f"madviz guard --policy {MAD} does it." in without.locator(".guard").inner_text()


def test_a_switch_acts_on_both_sides_until_each_has_its_own(visit, address):
    page = visit(address + LINK)
    page.wait_for_function("() => document.querySelectorAll('.view.off').length === 2")
    switch(page, "third_b", "off")
    page.wait_for_function("() => document.querySelectorAll('.view.off').length === 4")
    until(page, "Merged Only: Third B is off: action changed by 0.83", "#line")
    page.get_by_role("button", name="one side").click()
    switch(page, "third_b", "both", board=1)
    page.wait_for_function("() => document.querySelectorAll('.view.off').length === 3")
    assert tags(page, "third_b") == ["off", ""]


def test_sides_that_differ_have_switches_of_their_own_and_are_made_alike(visit, address):
    page = visit(address + f"#policy={MAD}&vs={MERGED_ONLY}&b.first=off&b.third_b=off@25")
    page.wait_for_function("() => document.querySelectorAll('.view.off').length === 1")
    assert page.locator(".board").count() == 2
    page.get_by_role("button", name="A and B").click()
    page.wait_for_function("() => document.querySelectorAll('.view.off').length === 0")
    assert page.locator(".board").count() == 1
    until(page, "drove the nail in", "#line")
    assert tags(page, "third_b") == ["", ""]


def test_an_act_s_switch_is_in_its_link_before_it_comes(visit, fitted):
    page = visit(
        fitted, script="navigator.clipboard.writeText = async text => { window.copied = text; };"
    )
    page.get_by_role("button", name="Next: First person goes black").click()
    until(page, "Which policy will still do it?", "#line")
    page.get_by_role("button", name="Copy link").click()
    assert "first=black@15" in page.evaluate("window.copied")


def test_what_a_visitor_did_is_in_the_address_and_plays_again(visit, address):
    page = visit(address + LINK)
    page.wait_for_function("() => document.querySelectorAll('.view.off').length === 2")
    page.keyboard.press(" ")
    page.keyboard.press("1")
    page.wait_for_function("() => /first=off@[0-9]+/.test(location.hash)")
    link = page.url
    assert "seed=5001" in link and "third_a=off@4" in link
    again = visit(link)
    again.wait_for_function("() => document.querySelectorAll('.view.off').length === 4")
    again.wait_for_function("() => /first=off@[0-9]+/.test(location.hash)")
    assert sorted(again.url.split("&")) == sorted(link.split("&"))


def test_a_switch_that_is_still_to_come_stays_in_the_address(visit, address):
    page = visit(address + f"{LINK}&first=off@25&guard=on", reduced_motion="reduce")
    page.wait_for_timeout(1500)  # Longer than the page waits before it writes.
    assert "first=off@25" in page.url and "guard=on" in page.url
    assert "step 0 of 30" in page.locator("#timeline").inner_text()


def test_a_refused_session_leaves_the_switches_that_are_still_to_come(
    visit, address, tmp_path: Path
):
    page = visit(address + f"{LINK}&first=off@25", reduced_motion="reduce")
    path = tmp_path / "session.json"
    path.write_text("{")
    page.locator("input[type=file]").set_input_files(path)
    page.wait_for_selector("#notices .notice")
    page.wait_for_timeout(1500)  # Longer than the page waits before it writes.
    assert "first=off@25" in page.url
    assert "Opening" not in page.locator("#line").inner_text()


def test_a_policy_that_is_being_loaded_is_named(visit, address):
    page = visit(address + LINK, reduced_motion="reduce")
    page.locator("#who").select_option(MERGED_ONLY)
    until(page, "Loading Merged Only …", "#line")
    page.wait_for_function("() => !document.querySelector('#line').innerText.includes('Loading')")
    assert page.locator("#headline").inner_text() == "Merged Only: Hammer"


def test_the_whole_page_opens_with_what_was_embedded(visit, address):
    page = visit(f"{address}?embed{LINK}")
    with page.context.expect_page() as opened:
        page.get_by_text("Open the whole page").click()
    whole = opened.value
    whole.wait_for_selector("body[data-ready]")
    assert f"policy={MAD}" in whole.url and "third_a=off@4" in whole.url
    assert whole.locator(".board").first.is_visible(), "there are switches to try"


def test_a_link_that_is_pasted_into_an_open_page_is_followed(visit, address):
    page = visit(address)
    page.evaluate(f"location.hash = '#policy={MERGED_ONLY}&seed=5002&first=black@2'")
    until(page, "Merged Only: Hammer", "#headline")
    page.wait_for_function(
        "() => document.querySelector('.view[data-camera=first] .tagged')?.textContent === 'black'"
    )
    assert page.locator(".side").count() == 1
    assert page.locator("#seed").input_value() == "5002"


@pytest.mark.parametrize(
    ("link", "words"),
    [
        ("#policy=gone", "“gone” is not on this site"),
        (f"#policy={MAD}&seed=7", "Seed 7 has no start state here"),
        (f"#policy={MAD}&top=off", "Hammer has no camera “top”"),
        (f"#policy={MAD}&third_a=offf@2", "cannot be read"),
        ("#%E0%A4%A", "cannot be decoded"),
    ],
)
def test_a_broken_link_gets_a_sentence_and_the_page_lives(visit, address, link, words):
    page = visit(address + link)
    assert words in until(page, words, "#notices")
    page.wait_for_function("() => document.querySelectorAll('.view').length >= 3")
    page.get_by_role("button", name="Close this message").first.click()
    assert page.locator("#notices .notice").count() == 0


def test_a_hostile_session_gets_a_sentence_and_the_page_lives(visit, address, tmp_path: Path):
    page = visit(address + LINK)
    for content in ("{", "[" * 10_000, '{"schema": 1}', "\x00" * 50):
        path = tmp_path / "session.json"
        path.write_text(content)
        page.locator("input[type=file]").set_input_files(path)
        page.wait_for_function("() => document.querySelector('#notices .notice')")
        page.get_by_role("button", name="Close this message").first.click()
    large = tmp_path / "large.json"
    large.write_bytes(b" " * 5_000_000)
    page.locator("input[type=file]").set_input_files(large)
    until(page, "so it is no saved session", "#notices")
    switch(page, "first", "off")
    page.wait_for_function("() => document.querySelector('.view[data-camera=first].off')")


def test_a_session_is_saved_as_a_file(visit, address):
    page = visit(address + LINK)
    with page.expect_download() as download:
        page.get_by_role("button", name="Save", exact=True).click()
    assert json.loads(Path(download.value.path()).read_text())["made_by"] == "site"


def test_a_box_that_is_dragged_on_a_picture_is_a_patch(visit, address):
    page = visit(address + LINK)
    area = page.locator(".side .view[data-camera=first] .picture").first.bounding_box()
    page.mouse.move(area["x"] + 20, area["y"] + 30)
    page.mouse.down()
    page.mouse.move(area["x"] + 80, area["y"] + 90, steps=4)
    page.mouse.up()
    page.wait_for_function("() => document.querySelectorAll('.tagged')[0].textContent === 'patch'")
    page.wait_for_function("() => /first=patch:1:/.test(location.hash)")


def test_keys_do_what_buttons_do(visit, address):
    page = visit(address + LINK)
    page.locator("#headline").click()
    page.keyboard.press("3")
    page.wait_for_function("() => document.querySelector('.view[data-camera=third_b].off')")
    page.keyboard.press(" ")
    until(page, "Play", ".play")
    page.keyboard.press("n")
    page.wait_for_function("() => document.querySelector('#seed').value === '5002'")


def test_success_is_counted_beside_what_was_measured(visit, address):
    page = visit(address + f"#policy={MAD}&vs={MERGED_ONLY}&first=off")
    page.get_by_role("button", name="Run 20").click()
    until(page, "20 of 20 episodes, A 20 of 20, B 0 of 20 successful", ".many")
    rows = page.locator("table.success tr.current")
    page.wait_for_function("() => document.body.innerText.includes('n=20')")
    assert "1.00 [0.84, 1.00] n=20" in rows.nth(0).inner_text()
    assert "0.00 [0.00, 0.16] n=20" in rows.nth(1).inner_text()


@pytest.mark.parametrize("width", [390, 768, 1280, 1920])
@pytest.mark.parametrize("query", ["", "?embed"])
def test_nothing_sticks_out_at_any_width(visit, address, width, query):
    page = visit(address + query + LINK, viewport={"width": width, "height": 800})
    page.get_by_role("button", name="Break or move").first.click()
    wide = page.evaluate("() => document.documentElement.scrollWidth")
    assert wide <= width
    assert page.locator(".tag").is_visible() == (query == "" and width > 640)


BOXES = """() => Object.fromEntries(['#stage', '#controls', '.drawer', '#timeline'].map(name => {
  const box = document.querySelector(name).getBoundingClientRect();
  return [name, [box.top, box.bottom]];
}))"""

SAYS = """lines => {
  document.querySelector('#line').replaceChildren(...Array.from({length: lines}, () => {
    const line = document.createElement('div');
    line.textContent = 'What came of it.';
    return line;
  }));
  return new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)));
}"""
"""The line under the headline takes so many lines, as the words of an ending do."""


@pytest.mark.parametrize(
    "query, width, height",
    [("", 1280, 800), ("", 390, 844), ("?embed", 800, 600), ("?embed", 1000, 700)],
)
def test_switches_never_cover_what_they_control(visit, address, query, width, height):
    # It stands still, or the words of an ending would take the place of those of the test.
    options = {"viewport": {"width": width, "height": height}, "reduced_motion": "reduce"}
    page = visit(address + query + LINK, **options)
    page.get_by_role("button", name="Break or move").nth(1).click()
    page.locator(".drawer h3", has_text="Break or move Third A").wait_for()
    page.locator(".drawer select").first.select_option("noise")
    page.locator(".drawer").get_by_text("strength", exact=True).wait_for()
    for lines in (1, 2, 3):
        page.evaluate(SAYS, lines)
        boxes = page.evaluate(BOXES)
        assert boxes["#stage"][1] <= boxes["#controls"][0] + 1
        assert boxes["#controls"][1] <= boxes["#timeline"][0] + 1
        assert boxes[".drawer"][1] <= height, f"what was opened is in sight, with {lines} lines"
        if width > 390:
            assert boxes["#stage"][0] >= 0, "and so are the pictures that it changes"
    page.get_by_role("button", name="Break or move").nth(1).click()
    assert page.locator(".drawer").is_hidden()


def test_all_that_can_be_pressed_has_a_name(visit, address):
    page = visit(address + LINK)
    page.get_by_role("button", name="Break or move").first.click()
    nameless = page.locator("button, select, input, canvas, a").evaluate_all(
        "all => all.filter(one => !(one.ariaLabel || one.innerText?.trim() || one.labels?.length"
        " || one.title)).map(one => one.outerHTML.slice(0, 120))"
    )
    assert nameless == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_enough_contrast(visit, address, scheme):
    page = visit(address, color_scheme=scheme)
    pairs = [("--ink", "--ground"), ("--soft", "--ground"), ("--soft", "--surface")]
    pairs += [("--good", "--surface"), ("--bad", "--surface"), ("--on-accent", "--accent")]
    pairs += [("--soft", "--sunken"), ("--note", "--surface"), ("--ink", "--note-ground")]
    for text, ground in pairs:
        light, dark = sorted(map(brightness, (value(page, text), value(page, ground))))[::-1]
        assert (light + 0.05) / (dark + 0.05) >= 4.5, f"{text} on {ground}"


def value(page: Any, name: str) -> str:
    """A colour of the style sheet, as ``#rrggbb``."""
    return page.evaluate(
        "name => getComputedStyle(document.documentElement).getPropertyValue(name).trim()", name
    )


def brightness(colour: str) -> float:
    """Relative luminance as WCAG 2 defines it."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [
        part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
    ]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_less_motion_means_that_nothing_starts_by_itself(visit, address):
    page = visit(address, reduced_motion="reduce")
    page.wait_for_timeout(500)
    assert "step 0 of 30" in page.locator("#timeline").inner_text()


def test_less_motion_leaves_a_button_that_starts_the_first_act(visit, fitted):
    page = visit(fitted, reduced_motion="reduce")
    page.wait_for_timeout(500)
    assert "step 0 of 30" in page.locator("#timeline").inner_text()
    page.get_by_role("button", name="Play").click()
    until(page, "MAD and Merged Only both drove the nail in.", "#line")
    page.get_by_role("button", name="Again").click()
    playing = "/step ([1-9]|1[0-9]) of 30/.test(document.querySelector('#timeline').innerText)"
    page.wait_for_function(f"() => {playing}")


def test_the_link_past_the_header_leads_to_the_robots_and_changes_nothing(visit, address):
    page = visit(address + LINK)
    page.wait_for_function("() => document.querySelectorAll('.view.off').length === 2")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "stage"
    page.wait_for_timeout(300)
    assert "policy=" in page.url and page.locator("#notices .notice").count() == 0
    assert page.locator(".view.off").count() == 2


def test_a_browser_without_webgl2_is_told(visit, address):
    page = visit(address, ready=False, script=NO_WEBGL)
    assert "has no WebGL2" in until(page, "WebGL2", "#notices")


def test_what_is_asked_for_comes_from_the_same_place(visit, address):
    page = visit(address, ready=False)
    seen: list[str] = []
    page.context.on("request", lambda request: seen.append(request.url))
    page.reload()
    page.wait_for_selector("body[data-ready]")
    until(page, "At step 15", "#line")
    assert any(url.endswith("worker.js") for url in seen), "workers are recorded, too"
    assert [url for url in seen if not url.startswith((address, "data:", "blob:"))] == []


def test_a_site_that_is_not_whole_says_so(visit, tmp_path: Path):
    fake_site(tmp_path / "broken", broken=True)
    folder = fake_site(tmp_path / "none")
    (folder / "manifest.json").unlink()
    fake_site(tmp_path / "script").joinpath("explorer.js").write_text("import './gone.js'")
    with served(tmp_path) as url:
        assert "cut off" in until(visit(f"{url}broken/", ready=False), "cut off", "#notices")
        assert "404" in until(visit(f"{url}none/", ready=False), "404", "#notices")
        words = until(visit(f"{url}script/", ready=False), "could not start", "#loading")
        assert "newer browser" in words


CLICKED = """async () => {
  const {SwitchBoard} = await import('./switches.js');
  const entry = {cameras: [{name: 'first', label: 'First'}], streams: ['first'], recorded: false};
  const board = new SwitchBoard([entry], 'a', () => {});
  document.body.append(board.element);
  const before = {cameras: {}, moves: {}};
  const [on, off] = board.element.querySelectorAll('input[type=radio]');
  board.update(before);
  off.click();
  board.update(before);
  const stands = off.checked;
  await new Promise(done => setTimeout(done, 1100));
  return [stands, on.checked];
}"""
"""A click, and a frame that was on its way; then no frame that shows what was asked for."""


def test_a_click_stands_until_a_frame_shows_it_or_none_comes(visit, address):
    assert visit(address).evaluate(CLICKED) == [True, True]


def test_who_drops_a_camera_is_asked_and_told(visit, address):
    page = visit(address + f"#policy={MERGED_ONLY}", reduced_motion="reduce")  # It stands still.
    page.locator("[data-camera=first] input[value=off]").check(force=True)
    until(page, "Will it still do it?", "#line")
    page.get_by_role("button", name="yes", exact=True).click()
    until(page, "You say yes.", "#line")
    page.get_by_role("button", name="Play", exact=True).click()
    until(page, "You said yes, but it did not.", "#line")
    page.get_by_role("button", name="Again", exact=True).click()
    page.get_by_role("button", name="Pause", exact=True).click()
    page.locator("[data-camera=first] input[value=both]").check(force=True)
    until(page, "First person is back", "#line")
    page.locator("[data-camera=first] input[value=off]").check(force=True)
    page.get_by_role("button", name="Just show me").click()
    page.locator("[data-camera=third_a] input[value=off]").check(force=True)
    until(page, "Third A is off", "#line")
    assert page.get_by_role("button", name="yes", exact=True).count() == 0
