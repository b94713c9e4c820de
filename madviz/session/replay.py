"""``madviz replay FILE``: replays saved episodes, without a page, and compares to the bit.

An episode depends on its seed and on which commands came at which step, so with the same policy,
the same packages and the same machine every action comes out the same. Where one does not, the
first step that differs is named, with what else is different: another policy of that name, other
versions, or neither, which leaves the machine (another CPU or another
OpenGL rounds differently).

An episode that a site kept was simulated and drawn in a browser. Its actions never agree to the
bit, so there the switches are replayed, and how the episode ended is compared.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, TypedDict

from madviz.envs.registry import make_env, sees
from madviz.errors import UserError
from madviz.guard.policy import SUFFIX
from madviz.measure.episodes import one_thread
from madviz.observation.displacement import MoveCamera
from madviz.observation.schedule import Event, in_order, schedule_words
from madviz.policies import checkpoint
from madviz.policies.guarded import reference_to, unguarded, with_guard
from madviz.policies.sb3 import trust
from madviz.session.commands import SetCamera
from madviz.session.session_file import (
    STREAMS,
    TRACE,
    SavedEpisode,
    SavedPolicy,
    SavedSession,
    versions_here,
)
from madviz.session.session_reader import read_session
from madviz.session.simulation import Simulation
from madviz.system.numbers import Count
from madviz.types import Environment, Policy

OTHERWISE = "another machine, or a file that was changed"
"""The reason where nothing is known to be different."""
EnvFactory = Callable[..., Environment]
Finder = Callable[[SavedPolicy], Policy]
"""The policy that is meant; any of that name, where the digest is another."""


@dataclass(frozen=True)
class ReplayConfig:
    """Replays saved episodes and says whether they come out the same, to the bit."""

    file: Path
    """The files that the page's button saved, or `madviz record --keep`."""
    policy: tuple[str, ...] = ()
    """Folders or module:factory of policies in the file that are not found by their names."""
    trust: bool = False
    """Loads the files of --policy sb3:FILE@TASK, which runs what is in them."""
    episode: Count | None = None
    """One of its episodes, from 1; by default all."""
    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""


class ReplayRow(TypedDict):
    """The result of one episode, as JSON has it."""

    policy: str
    task: str
    seed: int
    steps: int
    commands: int
    success: bool
    success_here: bool
    compared: Literal["bits", "outcome"]
    """``outcome`` for an episode that a site kept."""
    same_bits: dict[str, bool]
    """By stream: actions, rewards, success."""
    same: bool
    """The values that were compared."""
    first_difference: int | None
    """The decision, from 1, at which they part; None where no bits are compared."""
    reasons: list[str]


class ReplayResult(TypedDict):
    """The document that ``madviz replay --json`` writes."""

    schema: int
    file: str
    same: bool
    episodes: list[ReplayRow]


def run_replay(config: ReplayConfig) -> ReplayResult:
    """Replays the episodes of a file. Raises UserError for an unusable file, policy
    or task. ``same`` is whether all actions, rewards and successes are."""
    saved = read_session(config.file)
    chosen = saved.episodes if config.episode is None else (saved.episode(config.episode),)
    for policy in config.policy:
        trust(policy, config.trust)
    find = finder(config.policy)
    episodes = [replay_row(episode, saved, find) for episode in chosen]
    return {
        "schema": 1,
        "file": str(config.file),
        "same": all(episode["same"] for episode in episodes),
        "episodes": episodes,
    }


def finder(references: tuple[str, ...] = ()) -> Finder:
    """Loads policies by the plain names that files have, each once. ``references`` are looked
    at first, as they are and with or without a guard, as the wanted policy; only they, which the
    user typed, may be paths or modules."""
    load = cache(checkpoint.load_policy)
    typed = [load(reference) for reference in references]
    loaded: dict[SavedPolicy, Policy] = {}

    def find(wanted: SavedPolicy) -> Policy:
        given = list(typed)
        for reference in references:
            with suppress(UserError):  # It has no guard, and need not be the one that is wanted.
                given += [load(with_guard(unguarded(reference), wanted.name.endswith(SUFFIX)))]
        fitting = [policy for policy in given if SavedPolicy.of(policy.spec) == wanted]
        fitting += [policy for policy in given if SavedPolicy.of(policy.spec).name == wanted.name]
        if fitting:
            return fitting[0]
        if wanted not in loaded:
            try:
                loaded[wanted] = checkpoint.load_policy(reference_to(wanted.name))
            except UserError as error:
                raise UserError(
                    f"expected the policy {wanted.name!r} that acts in this file, found none here; "
                    "say where it is with --policy"
                ) from error
        return loaded[wanted]

    return find


def replay_episode(
    episode: SavedEpisode, find: Finder, env_factory: EnvFactory = make_env
) -> SavedEpisode:
    """The episode as it comes out here. Raises UserError where it cannot: another horizon, a task,
    camera or policy that is not here, a policy that cannot act on what is left."""
    first = find(episode.policy)
    with ExitStack() as stack:
        env = env_factory(episode.task, episode.render_profile, episode.cameras)
        stack.callback(env.close)
        check_episode(episode, find, env)
        simulation = Simulation(env, first, episode.ablation)
        stack.callback(simulation.leave)
        stack.enter_context(one_thread())
        simulation.begin(episode.seed)
        commands = list(episode.commands)
        for step in range(episode.steps + 1):
            while commands and commands[0].step == step:
                command = commands.pop(0).command
                if isinstance(command, SavedPolicy):
                    simulation.swap(find(command))
                elif isinstance(command, MoveCamera):
                    simulation.move_camera(command)
                else:
                    simulation.set_camera(command)
            if step < episode.steps:
                simulation.step(lambda: None)
    return simulation.journal.saved().episodes[-1]


def check_episode(episode: SavedEpisode, find: Finder, env: Environment) -> None:
    """Raises UserError where the episode cannot be replayed in ``env``: it is longer than its task,
    or a policy does not fit."""
    horizon = env.spec.horizon
    if episode.steps > horizon or episode.ended != (episode.steps == horizon):
        state = "ended" if episode.ended else "unfinished"
        raise UserError(
            f"expected {horizon} decisions in an episode of {episode.task}, found {state} after "
            f"{episode.steps}; save the session again, with this version of madviz"
        )
    check_policies(episode, find, env)


def check_policies(episode: SavedEpisode, find: Finder, env: Environment | None = None) -> None:
    """Raises UserError where one of its policies was made for another task; where there is an
    ``env``, also for cameras that it does not draw."""
    for policy in episode.policies:
        spec = find(policy).spec
        fits = (spec.task, spec.render_profile) == (episode.task, episode.render_profile)
        if not fits or (env is not None and not sees(env.spec, spec.cameras)):
            raise UserError(
                f"expected policies for {episode.task} ({episode.render_profile}) and its cameras, "
                f"found {policy.name!r} for {spec.task} ({spec.render_profile}); name another one "
                "with --policy"
            )


def replay_row(
    episode: SavedEpisode, saved: SavedSession, find: Finder, env_factory: EnvFactory = make_env
) -> ReplayRow:
    """Replays one episode and compares."""
    again = replay_episode(episode, find, env_factory)
    bits = saved.made_by == "madviz"
    same = comes_out_same(saved, episode, again)
    return {
        "policy": episode.policy.name,
        "task": episode.task,
        "seed": episode.seed,
        "steps": episode.steps,
        "commands": len(episode.start) + len(episode.commands),
        "success": episode.success,
        "success_here": again.success,
        "compared": "bits" if bits else "outcome",
        "same_bits": {
            name: getattr(again.sha256, name) == getattr(episode.sha256, name) for name in STREAMS
        },
        "same": same,
        "first_difference": first_difference(episode.trace, again.trace) if bits else None,
        "reasons": [] if same else differences(episode, saved, find) or [OTHERWISE],
    }


def comes_out_same(saved: SavedSession, episode: SavedEpisode, again: SavedEpisode) -> bool:
    """Whether ``again`` is what ``episode`` of ``saved`` was: to the bit, or, of a session that a
    site kept, in success at the last step."""
    if saved.made_by == "site":
        return again.success == episode.success
    return again.sha256 == episode.sha256


def first_difference(one: str, other: str) -> int | None:
    """The decision, from 1, at which two traces part."""
    for start in range(0, len(one), TRACE):
        if one[start : start + TRACE] != other[start : start + TRACE]:
            return start // TRACE + 1
    return None


def differences(episode: SavedEpisode, saved: SavedSession, find: Finder) -> list[str]:
    """The known differences to here: policies and versions."""
    found = []
    for policy in episode.policies:
        digest = SavedPolicy.of(find(policy).spec).digest
        if digest != policy.digest:
            found.append(
                f"{policy.name} had the digest {policy.digest[:12]}, here it has {digest[:12]}"
            )
    for package, version in versions_here().items():
        if saved.versions.get(package, version) != version:
            found.append(f"{package} was {saved.versions[package]}, here it is {version}")
    return found


def replay_words(result: ReplayResult) -> str:
    """The result as lines."""
    lines = []
    for number, row in enumerate(result["episodes"], 1):
        outcome = "success" if row["success"] else "no success"
        head = (
            f"episode {number}: {row['policy']} on {row['task']}, seed {row['seed']}, "
            f"{row['steps']} decisions, {row['commands']} commands, {outcome}"
        )
        lines.append(f"{head}: {_verdict(row)}")
    return "\n".join(lines)


def _verdict(row: ReplayRow) -> str:
    if row["compared"] == "outcome":
        here = "success" if row["success_here"] else "no success"
        word = "the same here" if row["same"] else f"here it is {here}, which DIFFERS"
        return f"{word} (kept by a site in a browser: outcomes are compared, not bits)"
    if row["same"]:
        return "actions, rewards and success are the same to the bit"
    different = [name for name, same in row["same_bits"].items() if not same]
    where = row["first_difference"]
    start = f" from decision {where} on" if where else ""
    return f"{' and '.join(different)} DIFFER{start}: {'; '.join(row['reasons'])}"


def policy_words(episode: SavedEpisode) -> str:
    """``A until step 10, then B``; '' where one policy acted all the time."""
    words = [
        f" until step {one.step}, then {one.command.name}"
        for one in episode.commands
        if isinstance(one.command, SavedPolicy)
    ]
    return "".join([episode.policy.name, *words]) if words else ""


def failure_words(episode: SavedEpisode) -> list[str]:
    """The failures of cameras, in the language of schedules, for a caption; moves have no words
    in it."""
    commands = [(0, command) for command in episode.start if isinstance(command, SetCamera)]
    commands += [
        (saved.step, saved.command)
        for saved in episode.commands
        if isinstance(saved.command, SetCamera)
    ]
    events = [
        Event(step, one.camera, one.state.input == "off", one.state.occlusion)
        for step, one in commands
    ]
    return schedule_words(in_order(events))
