"""``benchmarks places``: can one read from a camera's feature where the task's objects are?

The problem: a policy that fails on one camera alone may have been trained too little, or what
decides may not be in that camera's picture. A success rate does not tell the two apart.

The idea: the expert plays episodes. A camera's feature alone is what the policy's heads would read
if there were no other camera. From it, a linear map is fitted to where the task's objects and its
goal are (ridge regression), and judged on episodes that it was not fitted to, by how far off it is.
Beside it stand two controls: the mean place, which knows nothing of the episode, and the same map
from the state alone. ``in_picture`` says, from the camera's pose, in how many of the frames the
middle of the object lies within the picture; it may still be hidden behind something.

    explained = 1 - (squared error) / (squared error of the mean place)

    metaworld/peg-insert-side, goal    feature    state    mean    explained   in picture
    first                              4.1 cm     5.0 cm   5.2 cm  0.35        0.42
    third_a                            0.9 cm     5.0 cm   5.2 cm  0.97        1.00

(Numbers made up for the explanation.) A goal that stays where it is within an episode needs many
episodes, and few frames of each: one in ten.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.measure.episodes import one_thread
from madviz.measure.mean_picture import stack_of
from madviz.observation.ablation import Ablation
from madviz.policies.checkpoint import PolicyName, load_policy
from madviz.policies.config import check_environment
from madviz.policies.seeds import FIRST_DEVELOPMENT, FIRST_SELECTION, seeds_from
from madviz.subsets import camera_of
from madviz.system.numbers import Count, Seed, Share
from madviz.types import Array, CameraPose, Encoded, Environment, KnowsPlaces, Policy

STILL = 2e-3
"""Metres: what varies less over all frames is left out, because there is nothing to tell."""
FURTHEST = 5.0
"""Spreads from its mean that a number counts at most."""
PENALTIES = 10.0 ** np.arange(-4, 5)
"""Penalties of ridge regression, times the mean of the eigenvalues; chosen on a third of the fitted
episodes."""


@dataclass(frozen=True)
class PlacesConfig:
    """Reads the places of objects and goal from each camera's feature, on held-out episodes."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    policy: PolicyName = "metaworld-hammer-mad-light"
    """A policy that shows a feature for each stream."""
    episodes: Count = 150
    """Episodes that the maps are fitted to, from seed 1000 on."""
    judged: Count = 50
    """Episodes that judge them, from seed 5000 on."""
    every: Count = 10
    """One frame in so many is taken."""
    noise: Share = 0.2
    """Share of the expert's actions that are random, as in training."""
    seed: Seed = 0
    """The seed of the random actions."""


@dataclass(frozen=True)
class SeenPlaces:
    """The features and places of N frames, in the order of their episodes."""

    features: Array
    """(V, N, Z) float32."""
    states: Array
    """(N, S)."""
    places: Array
    """(N, P, 3) metres, world frame."""
    inside: Array
    """(V, N, P) bool: the place's middle lies within the stream's picture."""
    episodes: Array
    """(N,) which episode a frame is of."""


def bench_places(config: PlacesConfig) -> dict[str, Any]:
    """Errors by place and stream. Raises UserError for a task that does not say where things are,
    for a policy without features, and for more episodes than there are seeds."""
    policy = load_policy(config.policy)
    spec = policy.spec
    with closing(make_env(spec.task, spec.render_profile, spec.cameras)) as env, one_thread():
        check_environment(spec, env.spec)
        if not isinstance(env, KnowsPlaces):
            raise UserError(
                f"expected a task that says where its objects are, found {spec.task}; give its "
                "environment a method places() (madviz.types.KnowsPlaces)"
            )
        fitted = frames(env, policy, config, seeds_from(FIRST_SELECTION, config.episodes))
        judged = frames(env, policy, config, seeds_from(FIRST_DEVELOPMENT, config.judged))
        count = judged.places.shape[1]
        numbered = tuple(f"place {number + 1}" for number in range(count))
        names = getattr(env, "place_names", numbered)
    rows = [
        row for index in range(count) for row in _rows(spec.streams, names, index, fitted, judged)
    ]
    return {
        "schema": 1,
        "policy": spec.name,
        "task": spec.task,
        "episodes": config.episodes,
        "judged": config.judged,
        "frames": len(judged.states),
        "rows": rows,
    }


def frames(env: Environment, policy: Policy, config: PlacesConfig, seeds: range) -> SeenPlaces:
    """Every ``config.every``-th frame of the expert's episodes."""
    found: list[tuple[Array, ...]] = []
    for number, seed in enumerate(seeds):
        found += [(*frame, np.array(number)) for frame in _episode(env, policy, config, seed)]
    features, states, places, inside, episodes = (
        np.stack(each) for each in zip(*found, strict=True)
    )
    return SeenPlaces(features.swapaxes(0, 1), states, places, inside.swapaxes(0, 1), episodes)


def _episode(
    env: Environment, policy: Policy, config: PlacesConfig, seed: int
) -> Iterator[tuple[Array, ...]]:
    assert isinstance(env, KnowsPlaces)  # Any other was refused.
    rng = np.random.default_rng([config.seed, seed])
    spec = policy.spec
    stack = stack_of(spec, env.spec)
    now = env.reset(seed)
    for step in range(env.spec.horizon):
        due = step % config.every
        # A stack of L frames needs the L - 1 before it.
        if due == 0 or due > config.every - spec.frame_stack:
            cameras = dict.fromkeys(map(camera_of, spec.streams))
            stack.push({camera: env.view(camera) for camera in cameras}, Ablation(), seed, step)
        if due == 0:
            features = alone(policy, policy.encode(stack.views, now.state))
            if not features.any():
                raise UserError(
                    f"expected a policy with features, found {spec.name}, which has none"
                )
            places = env.places().reshape(-1, 3)
            inside = [in_picture(env.pose(camera_of(s)), places) for s in spec.streams]
            yield features, now.state, places, np.stack(inside)
        action = env.expert()
        if rng.random() < config.noise:
            action = rng.uniform(-1, 1, len(action)).astype(np.float32)
        now = env.step(action)


def alone(policy: Policy, encoded: Encoded) -> Array:
    """(V, Z) what the heads would read of each stream alone; its own feature, where the policy
    cannot act on one stream."""
    each = np.eye(len(policy.spec.streams), dtype=bool)
    if all(policy.supports(mask) for mask in each):
        return policy.read(encoded, each).merged
    return encoded.features


def in_picture(pose: CameraPose, points: Array) -> Array:
    """(P,) bool: which ``points`` (P, 3) lie within a square picture taken from ``pose``."""
    turn = Rotation.from_quat(pose.wxyz, scalar_first=True)
    x, y, z = turn.inv().apply(points - pose.position).T
    reach = np.tan(np.radians(pose.fovy) / 2) * z
    return (z > 0) & (np.abs(x) <= reach) & (np.abs(y) <= reach)


def _rows(
    streams: tuple[str, ...],
    names: tuple[str, ...],
    index: int,
    fitted: SeenPlaces,
    judged: SeenPlaces,
) -> list[dict[str, Any]]:
    """The rows of one place, one for each stream; none for a place that never changes."""
    target = fitted.places[:, index].astype(float)
    truth = judged.places[:, index].astype(float)
    if target.std(0).max() < STILL:
        return []
    mean = _error(np.broadcast_to(target.mean(0), truth.shape), truth)
    state = _error(ridge(fitted.states, target, fitted.episodes, judged.states), truth)
    rows = []
    for number, stream in enumerate(streams):
        features = fitted.features[number], judged.features[number]
        found = _error(ridge(features[0], target, fitted.episodes, features[1]), truth)
        rows.append(
            {
                "place": names[index],
                "stream": stream,
                "feature_cm": round(100 * found, 2),
                "state_cm": round(100 * state, 2),
                "mean_cm": round(100 * mean, 2),
                "explained": round(1 - (found / mean) ** 2, 3),
                "in_picture": round(float(judged.inside[number, :, index].mean()), 3),
            }
        )
    return rows


def _error(found: Array, truth: Array) -> float:
    """Metres: the root of the mean squared distance."""
    return float(np.sqrt(((found - truth) ** 2).sum(1).mean()))


def ridge(inputs: Array, targets: Array, episodes: Array, new: Array) -> Array:
    """(M, 3) what a linear map, fitted to ``inputs`` (N, Z) and ``targets`` (N, 3), makes of
    ``new`` (M, Z). Its penalty is the best on a third of the ``episodes`` (N,)."""
    mean = inputs.mean(0, dtype=float)
    std = inputs.std(0, dtype=float)
    scale = np.where(std > 1e-6, std, np.inf)  # What never changes says nothing.
    # Most numbers of a feature are rarely above 0; one that is for once must not decide all.
    inputs, new = (((each - mean) / scale).clip(-FURTHEST, FURTHEST) for each in (inputs, new))
    aside = episodes % 3 == 0
    tried = _solve(inputs[~aside], targets[~aside], inputs[aside], PENALTIES)
    errors = [((found - targets[aside]) ** 2).sum() for found in tried]
    return _solve(inputs, targets, new, PENALTIES[[int(np.argmin(errors))]])[0]


def _solve(inputs: Array, targets: Array, new: Array, penalties: Array) -> list[Array]:
    """The answers of ridge regression by penalty, in its dual form: N frames are fewer than Z
    numbers, so one (N, N) matrix is decomposed for all penalties."""
    middle = targets.mean(0)
    values, vectors = np.linalg.eigh(inputs @ inputs.T)
    values = values.clip(0)
    turned = vectors.T @ (targets - middle)
    across = new @ inputs.T @ vectors
    unit = values.mean() or 1.0  # Features that never change leave the mean.
    return [middle + across @ (turned / (values + p * unit)[:, None]) for p in penalties]


def places_words(result: dict[str, Any]) -> str:
    """The module's table."""
    lines = [
        f"{result['policy']}: where things are, read from features; {result['episodes']} episodes "
        f"fitted, {result['judged']} judged ({result['frames']} frames), error in cm",
        f"{'place':20}{'stream':16}{'feature':>9}{'state':>9}{'mean':>9}"
        f"{'explained':>11}{'in picture':>12}",
    ]
    for row in result["rows"]:
        errors = "".join(f"{row[key]:9.1f}" for key in ("feature_cm", "state_cm", "mean_cm"))
        lines.append(
            f"{row['place']:20}{row['stream']:16}{errors}{row['explained']:11.2f}"
            f"{row['in_picture']:12.2f}"
        )
    return "\n".join(lines)
