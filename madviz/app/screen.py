"""A picture that changes many times a second, and never goes blank or missing.

The problem: a browser loads a picture in the background, even one that came inside the page's own
text. Where every new frame replaces the element of the last one, a frame that comes before the last
one has loaded cancels it; at 30 frames a second on a busy machine a visitor saw none for half a
second, and a camera they had dropped stayed on the page that long.

The idea: the element stays, and frames queue for it, one at a time. The newest frame lies in an
invisible *feed*; a script takes it over whenever the picture before it has loaded:

    feed    f1  f2  f3  f4          what arrives
    image   f1 .... f2 . f4         what is shown: always a whole frame, the newest when it is ready

The image carries the step it shows, ``data-step``, so that nothing has to guess it from texts that
may be a frame ahead.
"""

from __future__ import annotations

from itertools import count

import viser

from madviz.app.panel import Assign
from madviz.drawing.jpeg import jpeg_url
from madviz.types import Array

_number = count()


class Screen:
    """One picture on the page (``browser/screen.js``). It travels as text, with the
    texts it belongs to: viser's own image widget decodes every picture twice and shows it a frame
    later."""

    def __init__(
        self, gui: viser.GuiApi, rgb: Array, step: str, alt: str, attributes: str = ""
    ) -> None:
        """``rgb`` (H, W, 3) uint8, the first picture. ``step`` names what it shows; scripts find
        the ``attributes`` on the image."""
        self._id = f"mv-screen-{next(_number)}"
        self._alt = alt
        self.handle = gui.add_html(self._element(rgb, step, attributes))
        self._feed = gui.add_html("")

    def _element(self, rgb: Array, step: str, attributes: str) -> str:
        height, width = rgb.shape[:2]
        return (
            f'<div style="padding:0 10px 6px"><img id="{self._id}" class="mv-mosaic" '
            f'alt="{self._alt}" width="{width}" height="{height}" '
            'style="width:100%;height:auto;display:block" '
            f'{attributes} fetchpriority="high" decoding="sync" data-step="{step}" '
            f'src="{jpeg_url(rgb)}"></div>'
        )

    def fit(self, rgb: Array, step: str, attributes: str) -> Assign:
        """A picture of another size."""
        return Assign(self.handle, "content", self._element(rgb, step, attributes))

    def show(self, rgb: Array, step: str) -> Assign:
        """Another picture of the same size."""
        feed = (
            f'<i class="mv-feed" data-screen="{self._id}" data-step="{step}" '
            f'data-src="{jpeg_url(rgb)}"></i>'
        )
        return Assign(self._feed, "content", feed)

    def remove(self) -> None:
        """Takes it off the page."""
        self.handle.remove()
        self._feed.remove()
