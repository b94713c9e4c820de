"""A page whose connection was cut and came back."""

from __future__ import annotations

import json

from madviz.app.server import App
from tests.e2e.conftest import PATIENCE, wait_until


def test_a_page_that_came_back_says_so_and_offers_what_was_played(app: App, visit) -> None:
    others = set(app.server.get_clients())  # Of tests before, whose pages are still closing.
    visitor = visit(app.url)
    assert visitor.page.locator("#mv-returned").count() == 0
    visitor.press("off")
    visitor.until("status.setting === 'third_a+third_b' && Number(status.step) > 3")
    clients = app.server.get_clients()
    (client,) = set(clients) - others
    handle = clients[client]
    connection = app.server._websock_server._live_connections[client]
    loop = handle._websock_connection.get_message_buffer().event_loop
    loop.call_soon_threadsafe(connection.transport.abort)
    wait_until(lambda: client not in app.server.get_clients())
    said = visitor.until_text("#mv-returned", "began anew", PATIENCE)
    assert "has come back" in said
    visitor.until("status.setting === 'all'")
    with visitor.page.expect_download() as download:
        visitor.page.get_by_role("link", name="Save what you played before").click()
    saved = json.loads(download.value.path().read_text())
    # Near an episode's end, the switch is how the next one starts.
    switched = [
        one["camera"]
        for episode in saved["episodes"]
        for one in (*episode["start"], *episode["commands"])
    ]
    assert "first" in switched
    visitor.page.get_by_role("button", name="Close this message").last.click()
    assert visitor.page.locator("#mv-returned").count() == 0
