"""Widgets for notebooks: a policy to play with, functions with sliders, questions before answers.

    from madviz.widgets import Explorer
    Explorer("metaworld-hammer-mad-light")

Each shows its present state also where a notebook is only displayed, and has no kernel.
"""

from madviz.widgets.explorer import Explorer
from madviz.widgets.notebook_page import LivePage, Viewer, live_page
from madviz.widgets.questions import Predict, TryOut

__all__ = ["Explorer", "LivePage", "Predict", "TryOut", "Viewer", "live_page"]
