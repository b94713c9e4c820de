"""Questions to the reader of a lesson: a slider to move, a prediction before the measurement."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

import ipywidgets

from madviz.errors import UserError
from madviz.teaching.show import Draws, Words
from madviz.widgets.static import StaticBox


class TryOut(StaticBox):
    """A function that draws, and a control for each of its arguments.

    ``TryOut(draw, n=(5, 200), rate=(0.0, 1.0, 0.05), camera=["first", "third_a"], squared=True)``:
    a pair or triple becomes a slider, a list a menu, True or False a tick.
    """

    def __init__(self, draw: Draws, **choices: Any) -> None:
        """``draw`` returns something of ``madviz.teaching.show``."""
        self.controls = {name: control_for(value) for name, value in choices.items()}
        self._draw = draw
        self.drawing = ipywidgets.HTML()
        for name, control in self.controls.items():
            control.description = name.replace("_", " ")
            control.style.description_width = "110px"
            control.layout.width = "420px"
            control.observe(lambda _: self._show(), "value")
        super().__init__([*self.controls.values(), self.drawing])
        self._show()

    def _show(self) -> None:
        values = {name: control.value for name, control in self.controls.items()}
        self.drawing.value = self._draw(**values).html

    def static_html(self) -> str:
        values = (f"{name} = {control.value}" for name, control in self.controls.items())
        return f"<p>{escape(', '.join(values))}</p>{self.drawing.value}"


def control_for(choice: Any) -> Any:
    """The control for an argument: a tick for a truth, a menu for a list, a slider for (lowest,
    highest) or (lowest, highest, step). Raises UserError for anything else."""
    if isinstance(choice, bool):
        return ipywidgets.Checkbox(choice)
    if isinstance(choice, list) and choice:
        return ipywidgets.Dropdown(options=choice)
    if isinstance(choice, tuple) and len(choice) in (2, 3):
        whole = all(isinstance(number, int) for number in choice)
        low, high, *steps = choice
        step = steps[0] if steps else 1 if whole else (high - low) / 100
        if whole:
            return ipywidgets.IntSlider((low + high) // 2, low, high, step)
        return ipywidgets.FloatSlider((low + high) / 2, min=low, max=high, step=step)
    raise UserError(f"expected True, False, a list or (lowest, highest), found {choice!r}")


class Predict(StaticBox):
    """A question to answer before the next cell is run; there is no grade."""

    def __init__(self, question: str, options: Sequence[str]) -> None:
        self._options = tuple(options)
        self.choice = ipywidgets.RadioButtons(
            options=self._options, value=None, layout={"width": "max-content"}
        )
        self._question = ipywidgets.HTML(f"<b>Predict first.</b> {escape(question)}")
        super().__init__([self._question, self.choice])

    @property
    def said(self) -> str | None:
        return self.choice.value

    def static_html(self) -> str:
        items = "".join(f"<li>{escape(option)}</li>" for option in self._options)
        return f"{self._question.value}<ul>{items}</ul>"

    def compare(self, measured: str) -> Words:
        """The prediction beside what was measured."""
        return Words(f"You predicted: {self.said or 'nothing yet'}. Measured: {measured}.")
