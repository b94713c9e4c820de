"""Checks that the saved processors of a LeRobot policy normalise as its configuration says.

LeRobot's normaliser leaves a feature as it is where it has no statistics of it, without a word. So
a file in which they are called otherwise gives a policy that acts on raw numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature

from madviz.errors import UserError

NEEDED = {
    NormalizationMode.MEAN_STD: ("mean", "std"),
    NormalizationMode.MIN_MAX: ("min", "max"),
    NormalizationMode.QUANTILES: ("q01", "q99"),
    NormalizationMode.QUANTILE10: ("q10", "q90"),
}


def check_normalisers(
    steps: list[Any],
    features: Mapping[str, PolicyFeature],
    modes: Mapping[str, NormalizationMode],
    where: str,
) -> None:
    """Raises UserError, which begins with ``where``, for a feature that ``modes`` says is
    normalised and that no step normalises, or not with statistics of its shape."""
    for key, feature in features.items():
        mode = NormalizationMode(modes.get(feature.type.value, NormalizationMode.IDENTITY))
        if mode is NormalizationMode.IDENTITY:
            continue
        step = next((step for step in steps if _normalises(step, key, feature, mode)), None)
        if step is None:
            raise UserError(
                f"{where}: expected a step that normalises {key} by {mode.value}, as config.json "
                "says, found none; save the processors again, as training does"
            )
        statistics = step.state_dict()  # Feature.number -> tensor
        lacking = [f"{key}.{name}" for name in NEEDED[mode] if f"{key}.{name}" not in statistics]
        if lacking:
            found = ", ".join(sorted(statistics)) or "none"
            raise UserError(
                f"{where}: expected the statistics {', '.join(lacking)}, found {found:.200}; save "
                "the processors again, with the statistics of the data that it was trained on"
            )
        count = feature.shape[0] if feature.type is FeatureType.VISUAL else math.prod(feature.shape)
        for name in NEEDED[mode]:
            if (numbers := statistics[f"{key}.{name}"].numel()) != count:
                raise UserError(
                    f"{where}: expected {key}.{name} of {count} numbers, found {numbers}; save the "
                    "processors again, with the statistics of the data that it was trained on"
                )


def _normalises(step: Any, key: str, feature: PolicyFeature, mode: NormalizationMode) -> bool:
    """True where ``step`` of a pipeline is a normaliser that is meant for ``key``."""
    modes = getattr(step, "norm_map", {})
    return key in getattr(step, "features", {}) and modes.get(feature.type) is mode
