"""Widgets that are also displayed where a notebook has no kernel."""

from __future__ import annotations

from typing import Any

import ipywidgets


class StaticBox(ipywidgets.VBox):
    """A box that also has HTML for where there are no widgets."""

    def static_html(self) -> str:
        """HTML for a page without a kernel."""
        return ""

    def _repr_mimebundle_(self, **kwargs: Any) -> Any:
        bundle = super()._repr_mimebundle_(**kwargs)
        if isinstance(bundle, dict):
            bundle["text/html"] = self.static_html()
        return bundle
