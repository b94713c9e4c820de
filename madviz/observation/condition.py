"""A condition: what a policy is given in an episode, or at one time step.

A condition says which streams are present, which of their cameras fail in which way, and which
stand elsewhere than in training. A policy plays a condition on a seed, and that gives an outcome:
every table of success rates here is made of such triples.

    Condition("all")                                         all cameras, intact
    Condition("first+third_b")                               third_a is dropped
    Condition("all", (("third_a", Occlusion("black")),))     third_a sends black
    Condition("first+third_b", begin=20)                     third_a is dropped at step 20

Two conditions that a policy cannot tell apart are made equal by ``noticed``: a dropped camera may
send black or not, and a blur does not depend on where a patch was.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

from madviz.observation.ablation import Ablation, CameraInput, CameraState, Occlusion
from madviz.observation.displacement import Moves
from madviz.subsets import camera_of, cameras_of, mask_of, modality_of, name_of
from madviz.types import Array

Occlusions = tuple[tuple[str, Occlusion], ...]
"""By camera, in a fixed order."""


@dataclass(frozen=True)
class Condition:
    """See the module."""

    subset: str
    """The streams that are present, in the language of ``subsets.py``."""
    occlusions: Occlusions = ()
    moves: Moves = ()
    begin: int = 0
    """The step from which it holds; until then all cameras are present and intact, but for moves,
    which hold from the first step on."""

    @staticmethod
    def of(ablation: Ablation, streams: tuple[str, ...]) -> Condition:
        """The condition of a policy with ``streams`` under ``ablation``."""
        occlusions = tuple(ablation.occlusions().items())
        subset = name_of(ablation.mask(streams), streams)
        return Condition(subset, occlusions, tuple(ablation.moves.items())).noticed(streams)

    def noticed(self, streams: tuple[str, ...]) -> Condition:
        """This condition without what a policy with ``streams`` cannot notice, in one spelling and
        order. Raises UserError for a subset that is none."""
        mask = self.mask(streams)
        present = {camera_of(s) for s, on in zip(streams, mask, strict=True) if on}
        occlusions = tuple(
            (camera, occlusion.effective)
            for camera, occlusion in sorted(dict(self.occlusions).items())
            if camera in present and occlusion.kind != "none"
        )
        return Condition(
            name_of(mask, streams),
            occlusions,
            tuple(
                (camera, move)
                for camera, move in sorted(dict(self.moves).items())
                if camera in present and not move.is_none
            ),
            self.begin if occlusions or not mask.all() else 0,
        )

    def at(self, step: int) -> Condition:
        """The condition of ``step`` alone."""
        now = self if step >= self.begin else Condition("all", (), self.moves)
        return replace(now, begin=0)

    def mask(self, streams: tuple[str, ...]) -> Array:
        """(V,) bool: the streams that are present. Raises UserError for a subset that is none."""
        return mask_of(self.subset, streams)

    def ablation(self, streams: tuple[str, ...]) -> Ablation:
        """The switches of all cameras under which a policy with ``streams`` gets this."""
        on = [s for s, present in zip(streams, self.mask(streams), strict=True) if present]
        occlusions = dict(self.occlusions)
        cameras: dict[str, CameraState] = {}
        for camera in cameras_of(streams):
            modalities = {modality_of(stream) for stream in on if camera_of(stream) == camera}
            switch: CameraInput = "both" if len(modalities) == 2 else "off"
            if len(modalities) == 1:
                switch = "rgb" if "rgb" in modalities else "depth"
            cameras[camera] = CameraState(switch, occlusions.get(camera, Occlusion()))
        return Ablation(cameras, dict(self.moves))

    def key(self) -> str:
        """A name for all but the subset, '' for none. Results are stored under it, beside the
        subset's name: it must not change."""
        parts = []
        for camera, occlusion in self.occlusions:
            values = asdict(occlusion)
            kind = values.pop("kind")
            if occlusion.width == occlusion.height:
                # Squares had one size when the first results were stored.
                del values["height"]
                values["size"] = values.pop("width")
            parts.append(f"{camera}:{kind}" + "".join(f",{k}={v:g}" for k, v in values.items()))
        parts += [f"{camera}:{move.key()}" for camera, move in self.moves]
        return ";".join(parts) + (f"@{self.begin}" if self.begin else "")

    def __str__(self) -> str:
        return " · ".join(filter(None, (self.subset, self.key())))
