"""The light recipe on recordings of a robot: its update, and no simulator.

    round: updates_per_round gradient steps ─► error on held-out episodes ─► state, policy, curve

The loss is that of ``light``. Nothing is recorded meanwhile, no student drives and nothing is
counted: in place of success stands, for each subset of cameras, how far the actions are from the
recorded ones on episodes that were held out before training, in units of the actions' spread.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from madviz.agent.agent import TorchPolicy
from madviz.errors import UserError
from madviz.observation.streams import IMAGE_SIZE
from madviz.plots import figures
from madviz.policies.card import write_card
from madviz.policies.config import TrainingRecord
from madviz.recorded.known import recordings_of
from madviz.recorded.recordings import Recordings
from madviz.recorded.robot import Robot, robot_of, write_robot
from madviz.runs.demonstrations import Dataset, Driver
from madviz.runs.run_folder import RunFolder, interruptible
from madviz.runs.training_plan import TrainingPlan
from madviz.subsets import every_mask, name_of
from madviz.system.files import allow_open_files, read_rows, write_bytes
from madviz.training.light import LightRun, report_round, train_light
from madviz.training.light_options import RECORDING, LightConfig
from madviz.types import Array

UNUSED = (
    *RECORDING,
    "demonstrations",
    "episodes_per_round",
    "position_weight",
    "critic_updates",
    "episodes",
    "workers",
)
"""Options of the light recipe that have no effect on recordings."""
MOST = 512
"""Held-out decisions on which the error is measured after each round."""
MOST_SUBSETS = 32
"""With more, the error is that of all cameras, of each removed and alone, and of none."""
ERROR = "error_"
"""The beginning of the curve's columns of errors."""


def imitate(plan: TrainingPlan, config: LightConfig, folder: RunFolder) -> None:
    """``train_light``, or ``train_recorded`` for recordings."""
    (train_recorded if plan.env.recorded else train_light)(plan, config, folder)


class RecordedDataset(Dataset):
    """Episodes of recordings, whose pictures stay in files: index i is one decision of any."""

    def __init__(
        self, recordings: Recordings, episodes: tuple[int, ...], robot: Robot, plan: TrainingPlan
    ) -> None:
        """``episodes``: the indices of those to learn from."""
        super().__init__(plan.spec.streams, len(episodes), plan.env.horizon)
        self.episodes = len(episodes)
        self._maps = [recordings.frames(episode, IMAGE_SIZE) for episode in episodes]
        names = [camera.name for camera in recordings.cameras]
        self._cameras = [names.index(stream) for stream in self.streams]
        numbers = [recordings.numbers(episode) for episode in episodes]
        lengths = [len(states) for states, _ in numbers]
        self._ends = np.cumsum(lengths)  # (E,)
        self._starts = self._ends - lengths
        actions = robot.actions.scale(np.concatenate([one for _, one in numbers]))  # (N, A)
        self._rows = {
            "states": robot.states.scale(np.concatenate([one for one, _ in numbers])),  # (N, S)
            "labels": actions,
            "actions": actions,
            "rewards": np.zeros(len(actions), np.float32),
        }

    def __len__(self) -> int:
        return int(self._ends[-1])

    def views(self, index: Array, length: int = 3) -> Tensor:
        episodes = self._episode(index)
        step = index - self._starts[episodes]  # (B,)
        back = np.maximum(step[:, None] - np.arange(length - 1, -1, -1), 0)  # (B, length)
        pairs = zip(episodes, back, strict=True)
        frames = np.stack([self._maps[one][rows][:, self._cameras] for one, rows in pairs])
        stacks = frames.transpose(0, 2, 1, 5, 3, 4)  # (B, V, length, 3, H, W)
        return torch.from_numpy(stacks.reshape(*stacks.shape[:2], 3 * length, *stacks.shape[4:]))

    def following(self, index: Array) -> Array:
        return np.minimum(index + 1, self._ends[self._episode(index)] - 1)

    def _episode(self, index: Array) -> Array:
        """(B,) the place in ``_maps`` of the episode that each decision belongs to."""
        return np.searchsorted(self._ends, index, side="right")


class RecordedRun(LightRun):
    """A run of the light recipe on recordings."""

    def __init__(self, plan: TrainingPlan, config: LightConfig, folder: RunFolder) -> None:
        """Decodes what is not in the cache. Raises UserError for options that have no effect, and
        for recordings of which nothing is left to learn from."""
        _check_options(config)
        super().__init__(plan, config, folder.path)
        known = recordings_of(plan.spec.task)
        recordings = known.prepared(
            IMAGE_SIZE,
            lambda n: folder.report("pictures", episode=n, of=len(known.episodes)),
        )
        for line in recordings.left_out:
            folder.report("left out", why=line)
        whole = {episode.index for episode in recordings.episodes}
        training = tuple(one for one in known.training if one in whole)
        self.held_out = tuple(one for one in known.held_out if one in whole)
        if not training:
            raise UserError(f"{known.path}: expected a whole episode to learn from, found none")
        digests = frozenset(map(known.digest, training))
        robot = robot_of(known)
        seen = tuple(one for one in robot.cameras if one.name in plan.spec.streams)
        self.robot = replace(robot, cameras=seen, trained_on=digests)
        allow_open_files(len(whole))
        self.data = RecordedDataset(recordings, training, self.robot, plan)
        self.look_at(np.arange(len(self.data)))
        self._validation = (
            RecordedDataset(recordings, self.held_out, self.robot, plan) if self.held_out else None
        )
        policy = TorchPolicy(plan.spec, self.average)
        self._shown = [mask for mask in _shown(len(plan.spec.streams)) if policy.supports(mask)]

    def drivers(self, round_index: int) -> list[tuple[Driver, int]]:
        return []

    @torch.inference_mode()
    def errors(self) -> dict[str, float]:
        """By subset, the mean distance from the recorded actions in held-out episodes; empty if
        none was held out."""
        data = self._validation
        if data is None:
            return {}
        merge = self.average.encoder
        masks = torch.from_numpy(np.stack(self._shown))  # (N, V)
        chosen = np.unique(np.linspace(0, len(data) - 1, MOST).round().astype(int))
        found = []
        for index in np.array_split(chosen, -(-len(chosen) // self.config.batch_size)):
            views = data.views(index)
            rows = merge.rows(merge.encode_to_act(views), masks, merge.noise_to_act(views))
            state = data.column("states", index).repeat(len(masks), 1)
            mean = self.average.actor(rows.flatten(0, 1), state)[0]
            action = torch.tanh(mean).float().unflatten(0, (len(masks), len(index)))  # (N, B, A)
            label = data.column("labels", index)
            found.append(self.robot.distance(action.numpy(), label.numpy()))  # (N, B)
        means = np.concatenate(found, axis=1).mean(axis=1)
        names = [name_of(mask, self.plan.spec.streams) for mask in self._shown]
        return dict(zip(names, means.tolist(), strict=True))


def train_recorded(plan: TrainingPlan, config: LightConfig, folder: RunFolder) -> None:
    """Trains on recordings, from the folder's last state on if it has one; Ctrl-C saves after the
    round at hand. Raises UserError as ``RecordedRun`` does."""
    run = RecordedRun(plan, config, folder)
    state = folder.load_state()
    if state:
        run.load(state)
    folder.truncate_curve("round", run.round)
    began = time.monotonic() - run.seconds
    with interruptible(folder) as stop:
        while run.round < config.all_rounds and not stop.is_set():
            loss = run.learn()
            errors = run.errors()
            run.seconds = time.monotonic() - began
            _report(run, folder, loss, errors)
            folder.save_state(run.state())
            if run.round < config.all_rounds:
                _save(run, folder)
        if run.round >= config.all_rounds:
            _save(run, folder)
            folder.finish()


def _check_options(config: LightConfig) -> None:
    if asked := config.asked(UNUSED):
        raise UserError(
            f"expected light options that have an effect on recordings, found {', '.join(asked)}; "
            "leave them out: nothing is played or recorded"
        )


def _shown(count: int) -> list[Array]:
    """The masks (V,) whose error is measured."""
    if 2**count <= MOST_SUBSETS:
        return list(every_mask(count))
    alone = np.eye(count, dtype=bool)
    return [np.ones(count, bool), *~alone, *alone, np.zeros(count, bool)]


def _save(run: RecordedRun, folder: RunFolder) -> None:
    """Writes the averaged weights as a policy, with its robot and its card."""
    plan = run.plan
    write_robot(folder.path, run.robot)
    held = ", ".join(map(str, run.held_out)) or "none"
    record = TrainingRecord(
        how="imitation of recordings; success was not measured",
        command=plan.command,
        labelled_episodes=run.data.episodes,
        updates=run.updates,
        batch_size=run.config.batch_size,
        alpha=plan.method.alpha_of(run.config.alpha),
        seeds=f"network and data {plan.seed}; held-out episodes: {held}",
        wall_time_s=round(run.seconds),
        finished=run.round >= run.config.all_rounds,
    )
    plan.save(folder, run.average, record)
    write_card(folder.path)


def _report(run: RecordedRun, folder: RunFolder, loss: float, errors: dict[str, float]) -> None:
    measured = {ERROR + name: round(error, 4) for name, error in errors.items()}
    report_round(run, folder, loss, measured)
    _draw_curve(folder.path, run.config.all_rounds)


def _draw_curve(folder: Path, rounds: int) -> None:
    """Draws the errors in ``curve.csv`` to ``curve.svg``: all cameras, each alone, and none."""
    rows = read_rows(folder / "curve.csv")
    columns = [column for column in rows[0] if column.startswith(ERROR)]
    series = {
        column.removeprefix(ERROR): [float("nan"), *(float(row[column]) for row in rows)]
        for column in columns
        if "+" not in column
    }
    if series:
        colours = {name: look.colour for name, look in figures.styles(list(series)).items()}
        title = "distance from held-out actions, in their spreads"
        figure = figures.curves(title, series, colours, {}, rounds, height=300, unit="round")
        write_bytes(folder / "curve.svg", figure.encode())
