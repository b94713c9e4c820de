"""``madviz record``: an episode without a page, as a rerun file, a film or a report.

The same session that a page shows is driven as fast as it goes, and every frame it emits is handed
to one writer. The name of the file chooses it:

    .rrd   everything, by step, for rerun's viewer: pictures, frusta, features, Q, action, mask
    .mp4   what the policy sees, with the state of every camera drawn in, and Q under it
    .html  one page that needs nothing else: pictures, curves, the outcome, how to make it again

``--vs POLICY`` makes a film of two policies on the same episodes, .mp4 for a talk or .webp for a
README (``madviz.recording.film``).

``--format lerobot`` writes many episodes to a folder instead, of a policy or of a task's expert:
demonstrations for whoever trains elsewhere (``madviz.recording.lerobot``).

With ``--replay`` the episode is one of a saved session; otherwise a policy and a seed make it, and
cameras fail when ``--drop`` or ``--scenario`` says (``madviz.observation.schedule``).
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from madviz.envs.registry import env_spec, make_env
from madviz.errors import UserError
from madviz.measure.episodes import one_thread
from madviz.observation.schedule import (
    ScenarioName,
    Schedule,
    in_order,
    parse_schedule,
    scenario,
    schedule_words,
)
from madviz.policies import checkpoint
from madviz.policies.guarded import with_guard
from madviz.policies.sb3 import trust
from madviz.policies.seeds import FIRST_TRY
from madviz.recorded.known import refuse_recording
from madviz.recording.facts import Facts, Writer
from madviz.recording.frames import frames, session_of
from madviz.session.commands import SetSchedule
from madviz.session.frame import Frame
from madviz.session.replay import comes_out_same, failure_words, finder, policy_words
from madviz.session.session_reader import read_session
from madviz.system.files import replacing, written_to
from madviz.system.numbers import Count, Range, Seed, Share, check_numbers
from madviz.system.options import changed, words_for
from madviz.types import EnvSpec
from madviz.wire.reference import with_wire


@dataclass(frozen=True)
class RecordConfig:
    """Records episodes without a page: a rerun file, a film or a report; many as a dataset."""

    out: Path
    """Where to: X.rrd for rerun's viewer, X.mp4 a film, X.html a report in one file, X.webp with
    --vs; with --format a new folder."""
    policy: checkpoint.PolicyName | None = None
    """A name of a policy, its folder, module:factory, or ws://HOST:PORT of one that is served;
    beside --replay, where to find it."""
    seed: Seed = FIRST_TRY
    """Which episode."""
    drop: tuple[str, ...] = ()
    """Cameras that fail: third_a@20 (dropped), third_a@20-40 (comes back), third_b=noise:0.5@10."""
    scenario: ScenarioName | None = None
    """Failures with a name, for example "lens covered"."""
    replay: Path | None = None
    """A saved session to record instead; policy, seed and failures are its own."""
    episode: Count | None = None
    """Which episode of the saved session, from 1; by default the last."""
    steps: Count | None = None
    """Decisions to record; by default all there are."""
    tile: Annotated[int, Range(int, 84, 1024)] = 252
    """Pixels that a camera's picture is wide in a film."""
    fps: Annotated[float, Range(float, 0.5, 120)] = 10.0
    """Decisions in a second of film."""
    keep: Path | None = None
    """Also write the episode as a saved session, for `madviz replay`."""
    json: str | None = None
    """Write what was recorded to this file; ``-``: to standard output, and nothing else there."""
    wire: Path | None = None
    """A served policy's names and shapes, a TOML file; madviz serve says them itself."""
    guard: bool = False
    """A camera that fails is left out until it works again; `madviz guard` fits what notices."""
    trust: bool = False
    """Whether the file of sb3:FILE@TASK may be loaded, which runs what is in it."""
    format: Literal["lerobot"] | None = None
    """lerobot: a LeRobot dataset, from --seed on."""
    expert: str | None = None
    """With --format: the task whose scripted expert acts, in place of a policy."""
    episodes: Count = 1
    """With --format or --vs: how many, from --seed on."""
    noise: Share = 0.0
    """With --expert: the largest standard deviation of a noise that is added to what the expert
    does, not to what is kept as its action. Each episode draws its own."""
    vs: checkpoint.PolicyName | None = None
    """A second policy on the same episodes, for a film of both."""
    acts: bool = False
    """With --vs: every seed thrice: all cameras, with the failures, and with the guard as well."""
    video: bool = False
    """With --format: colour pictures as films, which are smaller and not exact."""


def check(config: RecordConfig) -> None:
    """Raises UserError for numbers out of range and words that exclude each other."""
    check_numbers(config)
    if config.guard and (config.policy is None or config.replay is not None):
        raise UserError(
            "expected --policy beside --guard, and no --replay or --expert; leave --guard out"
        )
    if config.format is not None:
        return check_dataset(config)
    if config.vs is not None:
        return check_film(config)
    of_dataset = config.expert is not None or config.noise or config.video
    if of_dataset or config.episodes > 1 or config.acts:
        raise UserError(
            "expected --format lerobot beside --expert, --noise or --video, --vs beside --acts, "
            "one of both beside --episodes, found none; add it"
        )
    if config.replay is None and config.policy is None:
        raise UserError("expected --policy NAME or --replay FILE, found neither; give one")
    if config.replay is None and config.episode is not None:
        raise UserError("expected --replay FILE beside --episode, found none; give it, or --seed")
    own = config.drop or config.scenario or config.steps or config.seed != FIRST_TRY
    if config.replay is not None and own:
        raise UserError(
            "expected a saved session to have seed, failures and length of its own, found --seed, "
            "--drop, --scenario or --steps beside --replay; leave them out"
        )


def check_film(config: RecordConfig) -> None:
    """``check`` for ``--vs``."""
    if config.policy is None:
        raise UserError("expected --policy NAME beside --vs, found none; give one")
    if config.replay or config.keep or config.steps or config.episode or config.expert:
        raise UserError(
            "expected whole episodes with --vs, found --replay, --keep, --steps, --episode or "
            "--expert; leave them out"
        )
    if config.video or config.noise:
        raise UserError("expected --vs without --video and --noise, found one; leave it out")
    check_out(config.out, (".mp4", ".webp"))


def check_dataset(config: RecordConfig) -> None:
    """``check`` for ``--format``."""
    if (config.policy is None) == (config.expert is None):
        raise UserError(
            f"expected --policy NAME or --expert TASK, found "
            f"{'neither' if config.policy is None else 'both'}; give one"
        )
    if config.replay or config.keep or config.steps or config.episode:
        raise UserError(
            "expected whole episodes with --format, found --replay, --keep, --steps or --episode; "
            "leave them out"
        )
    if config.vs is not None or config.acts:
        raise UserError("expected --format without --vs and --acts, found one; leave it out")
    if config.expert is not None and (config.drop or config.scenario):
        raise UserError(
            "expected an expert to need no cameras, found --drop or --scenario; leave them out"
        )
    if config.noise and config.expert is None:
        raise UserError("expected --noise beside --expert, found a policy; leave it out")


def writer_for(path: Path, facts: Facts) -> Writer:
    """The writer that ``path`` asks for. Raises UserError as ``check_out`` does."""
    check_out(path)
    if path.suffix == ".rrd":
        from madviz.recording.rerun import RerunWriter

        return RerunWriter(path, facts)
    if path.suffix == ".mp4":
        from madviz.recording.video import VideoWriter

        return VideoWriter(path, facts)
    from madviz.recording.html import HtmlWriter

    return HtmlWriter(path, facts)


def check_out(path: Path, endings: tuple[str, ...] = (".rrd", ".mp4", ".html")) -> None:
    """Raises UserError for an ending that is no format, and for what cannot be written to."""
    if path.suffix not in endings:
        raise UserError(
            f"--out {path}: expected a name that ends in {', '.join(endings[:-1])} or "
            f"{endings[-1]}, found {path.suffix or 'no ending'}; choose one of them"
        )
    written_to(path, "--out")


def run_record(config: RecordConfig) -> dict[str, Any]:
    """Records what ``config`` says. Raises UserError for whatever in it will not do. ``same`` is
    whether a saved episode came out as it was, to the bit; null where there was none."""
    check(config)
    if config.format is not None:
        return run_dataset(config)
    if config.vs is not None:
        return run_film(config)
    check_out(config.out)
    if config.keep is not None:
        written_to(config.keep, "--keep")
    saved = read_session(config.replay) if config.replay else None
    script = saved.episode(config.episode) if saved else None
    named = _reference(config)
    find = finder((named,) if named else ())
    policy = find(script.policy) if script else checkpoint.load_policy(named)
    world = script or policy.spec
    refuse_recording(world.task, "madviz record")
    with closing(make_env(world.task, world.render_profile, world.cameras)) as env, one_thread():
        session = session_of(env, policy, config.seed, script, find)
        schedule = _schedule(config, env.spec)
        session.send(SetSchedule(schedule))
        failures = failure_words(script) if script else schedule_words(schedule)
        policies = policy_words(script) if script else ""
        facts = Facts(command_of(config), tuple(failures), config.fps, config.tile, policies)
        steps = script.steps if script else config.steps
        last, size = write_all(config.out, facts, frames(session, steps))
    if config.keep is not None:
        session.save(present_only=True).write(config.keep)
    end = last.world
    return {
        "schema": 1,
        "out": str(config.out),
        "bytes": size,
        "policy": end.policy.name,
        "task": end.env.task,
        "seed": end.seed,
        "steps": end.step,
        "failures": failures,
        "success": bool(end.success),  # An environment of the user's may give NumPy's.
        "success_any": bool(end.success_any),
        "return": float(end.total_reward),
        "same": comes_out_same(saved, script, session.save().episodes[-1])
        if saved and script
        else None,
    }


def run_film(config: RecordConfig) -> dict[str, Any]:
    """``run_record`` for ``--vs``."""
    from madviz.recording import film

    for policy in (config.policy, config.vs):
        trust(policy, config.trust)
    named = (with_wire(config.policy or "", config.wire), str(config.vs))
    spec = checkpoint.load_policy(named[0]).spec
    refuse_recording(spec.task, "madviz record")
    env = env_spec(spec.task, cameras=spec.cameras)
    schedule = _schedule(config, env)
    seeds = range(config.seed, config.seed + config.episodes)
    parts = film.chapters(env, seeds, schedule, config.acts, config.guard)
    with one_thread(), replacing(config.out) as part:
        rows = film.write_film(part, config.fps, parts, named)
        size = part.stat().st_size
    return {"schema": 1, "out": str(config.out), "bytes": size, "chapters": rows}


def run_dataset(config: RecordConfig) -> dict[str, Any]:
    """``run_record`` for ``--format``."""
    from madviz.recording import lerobot

    lerobot.check_folder(config.out)
    named = _reference(config)
    policy = checkpoint.load_policy(named) if named else None
    spec = policy.spec if policy else None
    refuse_recording(str(config.expert) if spec is None else spec.task, "madviz record")
    world = env_spec(str(config.expert)) if spec is None else spec
    seeds = range(config.seed, config.seed + config.episodes)
    with closing(make_env(world.task, world.render_profile, world.cameras)) as env, one_thread():
        schedule = _schedule(config, env.spec)
        streams = tuple(one.name for one in env.spec.cameras)
        played = (
            lerobot.policy_decisions(policy, env, schedule, seed)
            if policy
            else lerobot.expert_decisions(env, streams, config.noise, seed)
            for seed in seeds
        )
        ends, decisions = lerobot.write_dataset(
            config.out, env.spec, config.fps, played, config.video
        )
    return {
        "schema": 1,
        "out": str(config.out),
        "bytes": sum(each.stat().st_size for each in config.out.rglob("*") if each.is_file()),
        "policy": spec.name if spec else "the expert",
        "task": env.spec.task,
        "seed": config.seed,
        "episodes": len(ends),
        "steps": decisions,
        "failures": schedule_words(schedule),
        "success": sum(ends) / len(ends),
    }


def write_all(out: Path, facts: Facts, episode: Iterator[Frame]) -> tuple[Frame, int]:
    """Writes a whole episode; its last frame, and how many bytes it takes. Whoever finds ``out``
    finds all of it: until then it has another name, and if the episode stops there is none."""
    try:
        with replacing(out) as part:
            writer = writer_for(part, facts)
            last = None
            try:
                for last in episode:
                    writer.add(last)
            finally:
                writer.close()
            assert last is not None
            written_to(part)  # Rerun does not say that the disk was full before its end.
            return last, part.stat().st_size
    except OSError as error:
        why = (error.strerror or str(error)).splitlines()[0]
        raise UserError(
            f"--out {out}: could not be written: {why:.200}; make room there or choose another"
        ) from error


def record_words(result: dict[str, Any]) -> str:
    """The result as two lines."""
    if "chapters" in result:
        lines = [f"{result['out']}: {result['bytes'] / 1e6:.1f} MB"]
        lines += [f"{c['title']}, seed {c['seed']}: {c['words']}" for c in result["chapters"]]
        return "\n".join(lines)
    if "episodes" in result:
        return (
            f"{result['out']}: {result['episodes']} episodes of {result['policy']} from seed "
            f"{result['seed']}, {result['success']:.0%} successful, {result['bytes'] / 1e6:.1f} MB"
        )
    lines = [
        f"{result['out']}: {result['steps']} decisions of {result['policy']}, seed "
        f"{result['seed']}, {'success' if result['success'] else 'no success'}, "
        f"{result['bytes'] / 1e6:.2f} MB",
    ]
    if result["same"] is False:
        lines.append("it did not come out as it was saved: `madviz replay` says where it differs")
    return "\n".join(lines)


def command_of(config: RecordConfig) -> str:
    """The command line that makes the recording again. Of paths only the last part: a report that
    is given away says nothing about whose folders it came from."""
    # An episode's seed is said, also the default one; a saved session has its own.
    usual = RecordConfig(config.out, seed=-1 if config.replay is None else config.seed)
    asked = changed(replace(config, keep=None, json=None), usual)
    if config.policy is not None:
        asked["policy"] = checkpoint.shown(config.policy)
    if config.replay is not None:
        asked["replay"] = config.replay.name
    if config.wire is not None:
        asked["wire"] = config.wire.name
    return shlex.join(["madviz", "record", *words_for(asked), "--out", config.out.name])


def _reference(config: RecordConfig) -> str:
    """The reference that ``load_policy`` gets, and the trust that it needs; '' without a policy."""
    trust(config.policy, config.trust)
    return with_guard(with_wire(config.policy or "", config.wire), config.guard)


def _schedule(config: RecordConfig, env: EnvSpec) -> Schedule:
    """The schedule of the scenario and of ``--drop`` together. Raises UserError for a failure that
    no decision would see."""
    named = scenario(config.scenario).schedule(env) if config.scenario else ()
    cameras = [camera.name for camera in env.cameras]
    events = in_order([*named, *parse_schedule(config.drop, cameras)])
    for event in events:
        if event.step >= env.horizon:
            raise UserError(
                f"expected failures before step {env.horizon}, where {env.task} ends, found "
                f"{event.camera!r} at step {event.step}; let it fail earlier"
            )
    return events
