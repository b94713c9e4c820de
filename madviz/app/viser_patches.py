"""Two changes to viser 1.1 that make the page answer sooner, behind one switch.

With ``MADVIZ_PATCH_VISER=0`` in the environment viser stays as it is: everything works, later.

*Messages take effect when they come.* viser's page plays messages at the pace at which the server
wrote them, by the time that is stamped on each. Let one come 60 ms late, because the browser was
busy. It sets a new pace: all that follow are held back until they are as late, and win back a
twentieth of the time between two.

    written    0   40   80  120  160  ...   ms
    comes      0  100  101  125  165
    in effect  0  100  138  175  213  ...   and still 50 ms late: 30 messages until it is not

That is right for an animation that shall be smooth. It is wrong for a camera that a visitor has
just dropped. The page holds back nothing that was written more than 0.1 s after the message before
it, so the clock that stamps messages runs ``FASTER`` times as fast. Nothing else reads it.

*The scene is drawn once for each change* (``browser/rendering.js``). viser goes on drawing for
250 ms after every message that concerns the scene, in case something arrives late. Without a GPU, a
scene that changes four times a second is then drawn all the time: what a visitor waits for shares
two cores with pictures that are all the same. Whatever changes asks viser for a picture, and viser
notes until when it shall go on: now + 250 ms. The script lets the clock run 250 ms late while viser
takes that note. Whatever really comes late, such as a decoded texture, asks for a picture of its
own; and viser draws one every second in any case.

viser also lets messages that concern the scene, and all that come after them, wait until the next
picture is drawn, unless the page is hidden. Those that only move or change what is there find the
page hidden while they are taken in: a camera that is switched off just then does not wait.

What both are worth, on two cores without a GPU (``benchmarks live``, one run each): 29.0 updates
a second and 121 ms until 95 % of the switches show with them; 24.4 and 135 ms without.
"""

from __future__ import annotations

import os
import time
from time import perf_counter
from types import SimpleNamespace

import viser
from viser.infra import _infra

from madviz.app.browser import read, run_once

SWITCH = "MADVIZ_PATCH_VISER"
FASTER = 100_000
"""Two messages are never closer than some 10 microseconds, which look like a second."""


def wanted() -> bool:
    """Whether viser is to be changed in this process."""
    return os.environ.get(SWITCH, "1") != "0"


def patch_sender() -> None:
    """For all servers of this process; it may be called again."""
    if wanted():
        # The module ``time``, but for the clock that messages are stamped with.
        clock = SimpleNamespace(**vars(time) | {"perf_counter": lambda: FASTER * perf_counter()})
        _infra.time = clock  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]


def patch_rendering(client: viser.ClientHandle) -> None:
    """For one visitor's page."""
    if wanted():
        run_once(client, "rendering", read("rendering.js"))
