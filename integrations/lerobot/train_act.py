"""Trains a small ACT of LeRobot's on demonstrations that madviz recorded, on a CPU.

    python train_act.py --data hammer --out act-hammer
    python train_act.py --data hammer --out act-hammer-dropout --view-dropout

The policy is LeRobot's (``lerobot.policies.act``), small enough for two cores: a ResNet-18 for all
cameras, a transformer of width 256, ten actions at once, no VAE, because the expert has one way of
doing things. No pretrained weights are downloaded.

``--view-dropout`` changes one thing: half of the updates see all cameras, as all of them do
without it; each other one sees a set of cameras that is drawn anew, and the tokens of the others
are left out. Data, network, updates and learning rate are the same.

ACT's norms are frozen, which a backbone without pretrained weights was not made for: activations
double from block to block, and grow with the weights. So the norms are measured: they follow what
passes them for the first half of the training, and stay in the second (``MovingNorms``). With norms
that were measured once, a training without view dropout ended in a constant action.

A training that was stopped goes on when the same command is given again.

An update of 32 decisions takes 0.4 s on two cores of an AMD EPYC with bfloat16 instructions (0.7 s
in float32), so that 4,000 take half an hour.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.types import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import DataLoader
from torchvision.ops import FrozenBatchNorm2d

from madviz.agent.agent import fast_bfloat16
from madviz.agent.augment import random_shift

CHUNK = 10
AFTER = 5
SUCCESS = "next.success"
WARM_UP = 100
BACKBONE = 0.5
"""The backbone's learning rate, as a share of the rest's."""
SAVE_EVERY = 200


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="of madviz record")
    parser.add_argument("--out", type=Path, required=True, help="a folder for the policy")
    parser.add_argument("--leave-out", type=int, nargs="*", default=[], help="episodes, by index")
    parser.add_argument("--view-dropout", action="store_true", help="mask cameras at random")
    parser.add_argument("--updates", type=int, default=3000, help="gradient steps")
    parser.add_argument("--batch", type=int, default=32, help="decisions in one")
    parser.add_argument("--learning-rate", type=float, default=3e-4, help="at the start")
    parser.add_argument("--action-steps", type=int, default=5, help="actions taken from one look")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    check_same(asked)
    return asked


def check_same(asked: argparse.Namespace) -> None:
    """Ends where the folder has a training with other options."""
    file = asked.out / "training.json"
    before = json.loads(file.read_text()) if file.exists() else {}
    for name, value in vars(asked).items():
        if name in before and name != "out" and before[name] != str(value):
            raise SystemExit(
                f"{asked.out}: expected --{name.replace('_', '-')} {before[name]}, with which its "
                f"training began, found {value}; choose another --out"
            )


class Demonstrations:
    """A dataset in memory, pictures or films: 100 decisions of three cameras at 84 pixels are 6.4
    MB. No update uses the episodes ``left_out``; the dataset's statistics, which scale states and
    actions, hold them."""

    def __init__(self, folder: Path, left_out: list[int]) -> None:
        self.loaded = LeRobotDataset(folder.name, root=folder, video_backend="pyav")
        self.keys = list(self.loaded.meta.camera_keys)
        if depths := self.loaded.meta.depth_keys:
            raise SystemExit(
                f"{folder}: expected pictures in colour alone, which ACT takes, found the depth "
                f"{', '.join(depths)}; record a policy without depth, or an expert"
            )
        columns = [OBS_STATE, ACTION, "episode_index", SUCCESS]
        numbers = self.loaded.hf_dataset.with_format("numpy", columns=columns)[:]
        self.states, self.actions = (torch.from_numpy(numbers[k]) for k in columns[:2])
        episode = numbers["episode_index"]
        if unknown := sorted(set(left_out) - set(episode.tolist())):
            raise SystemExit(
                f"--leave-out: expected episodes from 0 to {episode.max()}, found {unknown[0]}"
            )
        useful = useful_decisions(episode, numbers[SUCCESS].ravel())
        self.useful = useful[~np.isin(episode[useful], left_out)]
        if not len(self.useful):
            raise SystemExit("expected episodes to learn from, found none; leave fewer out")
        self.ends = np.searchsorted(episode, episode, side="right")
        height, width = self.loaded.meta.features[self.keys[0]]["shape"][:2]
        shape = len(episode), len(self.keys), 3, height, width
        self.pictures = torch.empty(shape, dtype=torch.uint8)
        for at, row in enumerate(DataLoader(self.loaded, batch_size=None, num_workers=2)):
            for camera, key in enumerate(self.keys):
                self.pictures[at, camera] = (row[key] * 255).round()

    def batch(self, index: np.ndarray, rng: np.random.Generator) -> dict[str, Tensor]:
        """What LeRobot's loader gives, with pictures moved by up to four pixels."""
        shifted = random_shift(self.pictures[index], rng).float() / 255
        steps = index[:, None] + np.arange(CHUNK)
        padded = steps >= self.ends[index][:, None]
        chunk = self.actions[np.minimum(steps, self.ends[index][:, None] - 1)]
        pictures = {key: shifted[:, at] for at, key in enumerate(self.keys)}
        return {
            **pictures,
            OBS_STATE: self.states[index],
            ACTION: chunk,
            "action_is_pad": torch.from_numpy(padded),
        }


def useful_decisions(episode: np.ndarray, succeeded: np.ndarray) -> np.ndarray:
    """Indices of what leads to a success: of each episode all decisions up to the first success and
    ``AFTER`` more, and nothing of an episode without one. What an expert does when it is done, or
    lost, would be most of what the policy learns."""
    kept = []
    for number in np.unique(episode):
        rows = np.flatnonzero(episode == number)
        good = np.flatnonzero(succeeded[rows])
        if len(good):
            kept.append(rows[: good[0] + AFTER + 1])
    if not kept:
        raise SystemExit(
            "expected demonstrations that succeed, found none; record with less --noise"
        )
    return np.concatenate(kept)


def new_policy(data: Demonstrations, learning_rate: float, action_steps: int) -> ACTPolicy:
    features = dataset_to_policy_features(data.loaded.meta.features)
    is_action = {k: f.type is FeatureType.ACTION for k, f in features.items()}
    config = ACTConfig(
        input_features={k: f for k, f in features.items() if not is_action[k]},
        output_features={k: f for k, f in features.items() if is_action[k]},
        chunk_size=CHUNK,
        n_action_steps=action_steps,
        dim_model=256,
        dim_feedforward=1024,
        n_encoder_layers=3,
        use_vae=False,
        pretrained_backbone_weights=None,
        optimizer_lr=learning_rate,
        optimizer_lr_backbone=learning_rate * BACKBONE,
        device="cpu",
    )
    return ACTPolicy(config)


class MovingNorms:
    """The frozen norms of a backbone, from what passes them: (N, C, H, W) before each.

    ``set`` takes mean and variance of some pictures. While ``moving``, those of every fourth
    picture are mixed in, ``SHARE`` of them, without a gradient. So the activations keep their size
    while the weights change, and the norms are the same in training and in use."""

    SHARE = 0.02

    def __init__(self, backbone: torch.nn.Module) -> None:
        self.moving, self._share, self._every = False, 1.0, 1
        self._backbone = backbone
        for module in backbone.modules():
            if isinstance(module, FrozenBatchNorm2d):
                module.register_forward_pre_hook(self._measure)

    def set(self, pictures: Tensor) -> None:
        """From ``pictures`` (N, 3, H, W), normalised."""
        self.moving, self._share = True, 1.0
        with torch.no_grad():
            self._backbone(pictures)
        self._share, self._every = self.SHARE, 4

    def _measure(self, norm: FrozenBatchNorm2d, inputs: tuple[Tensor, ...]) -> None:
        if self.moving:
            with torch.no_grad():
                seen = inputs[0][:: self._every].float()
                variance, mean = torch.var_mean(seen, (0, 2, 3))
                norm.running_mean.lerp_(mean, self._share)
                norm.running_var.lerp_(variance, self._share)


def drawn_cameras(count: int, rng: np.random.Generator) -> np.ndarray:
    """All cameras for half of the updates, else one of the other sets with at least one in it."""
    if rng.random() < 0.5:
        return np.arange(count)
    number = int(rng.integers(1, 2**count - 1))
    return np.array([camera for camera in range(count) if number >> camera & 1])


def loss_of(policy: ACTPolicy, batch: dict[str, Tensor], present: list[str]) -> Tensor:
    """ACT's own loss from the cameras ``present``; the model takes any list of pictures."""
    seen = {OBS_STATE: batch[OBS_STATE], OBS_IMAGES: [batch[key] for key in present]}
    predicted, _ = policy.model(seen)
    error = F.l1_loss(predicted, batch[ACTION], reduction="none")
    counts = ~batch["action_is_pad"][..., None]
    return (error * counts).sum() / (counts.sum() * error.shape[-1])


def main() -> None:
    asked = arguments()
    torch.manual_seed(asked.seed)
    data = Demonstrations(asked.data, asked.leave_out)
    policy = new_policy(data, asked.learning_rate, asked.action_steps)
    stats = data.loaded.meta.stats
    before, after = make_pre_post_processors(policy.config, dataset_stats=stats)
    policy.model.backbone.to(memory_format=torch.channels_last)
    first = before(
        data.batch(np.arange(0, len(data.states), len(data.states) // 32), np.random.default_rng(0))
    )
    norms = MovingNorms(policy.model.backbone)
    norms.set(torch.cat([first[key] for key in data.keys]))
    optimiser = torch.optim.AdamW(
        policy.get_optim_params(), lr=asked.learning_rate, weight_decay=1e-4, fused=True
    )
    rates = [group["lr"] for group in optimiser.param_groups]  # Of the rest, and of the backbone.
    low_precision = fast_bfloat16()
    done, seconds, curve = 0, 0.0, []
    state_file = asked.out / "resume.pt"
    if state_file.exists():
        state = torch.load(state_file, weights_only=True)
        policy.load_state_dict(state["policy"])
        optimiser.load_state_dict(state["optimiser"])
        done, seconds, curve = state["done"], state["seconds"], state["curve"]
    policy.train()
    recent: list[float] = []
    began = time.monotonic()
    while done < asked.updates:
        rng = np.random.default_rng([asked.seed, done])  # Of this update alone, for a resumed run.
        torch.manual_seed(asked.seed * 1_000_003 + done)
        index = data.useful[rng.integers(0, len(data.useful), asked.batch)]
        batch = before(data.batch(index, rng))
        cameras = np.arange(len(data.keys))
        if asked.view_dropout:
            cameras = drawn_cameras(len(cameras), rng)
        rate = min((done + 1) / WARM_UP, 1) * (1 - done / asked.updates)
        for group, start in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = start * rate
        norms.moving = done < asked.updates // 2
        with torch.autocast("cpu", torch.bfloat16, enabled=low_precision):
            loss = loss_of(policy, batch, [data.keys[at] for at in cameras])
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        optimiser.step()
        done += 1
        recent.append(loss.item())
        if done % 50 == 0:
            now = seconds + time.monotonic() - began
            curve.append([done, float(np.mean(recent)), round(now)])
            print(f"{done}/{asked.updates} loss {curve[-1][1]:.4f} after {now:.0f} s", flush=True)
            recent = []
        if done % SAVE_EVERY == 0 or done == asked.updates:
            asked.out.mkdir(parents=True, exist_ok=True)
            policy.save_pretrained(asked.out)
            before.save_pretrained(asked.out)
            after.save_pretrained(asked.out)
            trained = {**{k: str(v) for k, v in vars(asked).items()}, "curve": curve}
            (asked.out / "training.json").write_text(json.dumps(trained, indent=1))
            state = {
                "policy": policy.state_dict(),
                "optimiser": optimiser.state_dict(),
                "done": done,
                "seconds": seconds + time.monotonic() - began,
                "curve": curve,
            }
            torch.save(state, state_file.with_suffix(".part"))
            state_file.with_suffix(".part").replace(state_file)


if __name__ == "__main__":
    main()
