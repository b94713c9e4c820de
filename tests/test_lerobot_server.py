"""serve_policy.py of integrations/lerobot, with stand-ins for what it takes from LeRobot."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from madviz.envs.registry import env_spec
from madviz.errors import UserError
from madviz.types import Array, Encoded

FOLDER = Path(__file__).resolve().parent.parent / "integrations" / "lerobot"
KEYS = [f"observation.images.{camera}" for camera in ("first", "third_a", "third_b")]


class Samples:
    """A policy that draws each action, as SmolVLA and pi0 do."""

    @classmethod
    def from_pretrained(cls, folder: Path, config: Any) -> Samples:
        return cls()

    def eval(self) -> Samples:
        return self

    def reset(self) -> None:
        """It has no queue."""

    def select_action(self, batch: dict[str, Any]) -> torch.Tensor:
        return torch.rand(1, 2)


def config_of(folder: Path) -> SimpleNamespace:
    """The configuration of a policy for the toy, whose pictures' keys ``folder`` has by line."""
    keys = (folder / "config.json").read_text().split()
    return SimpleNamespace(
        type="samples",
        n_obs_steps=1,
        image_features={key: SimpleNamespace(shape=(3, 84, 84)) for key in keys},
        input_features={},
        output_features={},
        normalization_mapping={},
        robot_state_feature=SimpleNamespace(shape=(6,)),
        action_feature=SimpleNamespace(shape=(2,)),
    )


class Unchanged:
    """Processors that change nothing."""

    steps = ()

    def __call__(self, value: Any) -> Any:
        return value


MODULES: dict[str, dict[str, Any]] = {
    "lerobot.configs.policies": {"PreTrainedConfig": SimpleNamespace(from_pretrained=config_of)},
    "lerobot.policies.factory": {
        "get_policy_class": lambda kind: Samples,
        "make_pre_post_processors": lambda *_, **__: (Unchanged(), Unchanged()),
    },
    "lerobot.utils.constants": {
        "OBS_IMAGE": "observation.image",
        "OBS_IMAGES": "observation.images",
        "OBS_STATE": "observation.state",
    },
    "normalisers": {"check_normalisers": lambda *_: None},
}


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module serve_policy."""
    for name, members in MODULES.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setitem(sys.modules, "serve_policy", ModuleType("serve_policy"))
    del sys.modules["serve_policy"]  # It is imported anew, and gone after the test.
    return importlib.import_module("serve_policy")


def opened(served: Any, folder: Path, keys: list[str], **options: Any) -> Any:
    (folder / "config.json").write_text("\n".join(keys))
    return served.LeRobotPolicy(folder, env_spec("toy/reach"), **options)


def test_an_episodes_noise_is_its_seeds_whatever_else_acts(served: Any, tmp_path: Path) -> None:
    policy = opened(served, tmp_path, KEYS)
    look: Encoded = policy.encode(np.zeros((3, 3, 84, 84), np.uint8), np.zeros(6))
    mask = np.ones(3, bool)

    def acted(player: Any) -> Array:
        return player.act(look, mask)

    alone = policy.reset(7)
    expected = [acted(alone) for _ in range(3)]
    torch.manual_seed(1)
    before = torch.get_rng_state()
    one, found = policy.reset(7), []
    for seed in range(3):
        found.append(acted(one))
        acted(policy.reset(seed))
        policy.read(look, mask)
    np.testing.assert_array_equal(found, expected)
    assert not np.array_equal(expected[0], expected[1]), "each decision draws anew"
    assert not np.array_equal(acted(policy.reset(8)), expected[0]), "another seed, another noise"
    twice = policy.read(look, np.ones((2, 3), bool)).action
    np.testing.assert_array_equal(twice, np.repeat(policy.read(look, mask).action, 2, axis=0))
    assert torch.equal(torch.get_rng_state(), before), "the program's own noise is left alone"


@pytest.mark.parametrize(
    ("keys", "key", "said"),
    [
        (
            KEYS[:1],
            "observation.image",
            "third_a to name one of .*first, found 'observation.image'",
        ),
        (KEYS, "observation.image", "third_a to name one of .*, found 'observation.image'"),
        (KEYS, KEYS[0], "NAME=observation.images.third_a, found none; say which it is"),
    ],
)
def test_a_camera_under_a_key_that_will_not_do_is_refused(
    keys: list[str], key: str, said: str, served: Any, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=f"expected --camera {said}"):
        opened(served, tmp_path, keys, cameras={"third_a": key})


def test_a_policy_without_pictures_is_refused(served: Any, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected pictures of first.*, found none"):
        opened(served, tmp_path, [])


@pytest.mark.parametrize("folder", [".", "nowhere", "lerobot/smolvla_base"])
def test_a_folder_that_is_none_of_lerobots_is_refused(
    folder: str, served: Any, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="a folder of LeRobot's with config.json, found none"):
        served.LeRobotPolicy(tmp_path / folder, env_spec("toy/reach"))
