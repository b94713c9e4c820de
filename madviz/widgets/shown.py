"""Widgets that show what they are also where a notebook is only displayed, without a kernel."""

from __future__ import annotations

from typing import Any

import ipywidgets


class Shown(ipywidgets.VBox):
    """A box that also says what it shows where there are no widgets."""

    def still(self) -> str:
        """HTML for a page without a kernel."""
        return ""

    def _repr_mimebundle_(self, **kwargs: Any) -> Any:
        bundle = super()._repr_mimebundle_(**kwargs)
        if isinstance(bundle, dict):
            bundle["text/html"] = self.still()
        return bundle
