"""``madviz audit --policy P``: does a policy use its cameras?

    madviz audit --policy metaworld-hammer-mad-light --out audit-hammer

plays the same scenes with every camera removed and alone, and with none, and writes audit.html,
audit.json and audit.md. Every episode is kept in episodes.sqlite of that folder as it finishes, so
that an audit which was stopped goes on where it was, with the same command. policy.json says with
which policy and seed it began; another one is refused.

    madviz audit --policy metaworld-hammer-mad-light --along third_a.pan=-20:20 --out audit-hammer

asks another question, how much is too much (``along.py``), with the same episodes, and writes
along.html, along.json, along.md and along.csv.

    madviz audit --recording DATASET --policy my-mad --out audit-mine

asks how much the action owes to each camera, on recordings (``recorded.py``).
"""

from __future__ import annotations

import shlex
import sys
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from madviz.envs.registry import TaskName, env_spec
from madviz.errors import Interrupted, UserError, saving, signal_of
from madviz.guard.policy import guard_note
from madviz.measure.audit.account import account
from madviz.measure.audit.along import EPISODES as ALONG_EPISODES
from madviz.measure.audit.along import AlongFile, along
from madviz.measure.audit.along_account import along_account, along_csv, along_words
from madviz.measure.audit.audited_policy import FILE, check_same_policy, repeats_itself
from madviz.measure.audit.document import AuditFile, audit_document
from madviz.measure.audit.guarded import guarded_rows
from madviz.measure.audit.lost_cameras import HOWS, INTACT, Cameras, How
from madviz.measure.audit.recorded import RecordedAudit, RecordedAuditFile, recorded_audit
from madviz.measure.audit.recorded_account import recorded_account, recorded_words
from madviz.measure.audit.schedule import AuditPlan, Outcomes
from madviz.measure.audit.sentences import in_words, plan_words, planned
from madviz.measure.audit.turned import along_pairs, audit_pairs
from madviz.measure.blocks import Block, html, markdown
from madviz.measure.episodes import FIRST_SEED, Job, Runner
from madviz.measure.pairs import MOST as MOST_PAIRS
from madviz.measure.pairs import pair_blocks
from madviz.measure.store import MEMORY, Store
from madviz.measure.table import Table, seeds_of_run
from madviz.observation.condition import Condition
from madviz.policies import checkpoint
from madviz.policies.guarded import with_guard
from madviz.policies.sb3 import trust
from madviz.recorded.known import LABEL, allow_recording, recordings_of
from madviz.recorded.robot import robot_for_any_policy
from madviz.system.address import without_secrets
from madviz.system.files import read_json, write_bytes, write_json, written_to
from madviz.system.numbers import Count, Range, Seed, ThreadsOrNone
from madviz.system.options import changed, words_for
from madviz.types import Policy
from madviz.wire.reference import with_wire

EPISODES = "episodes.sqlite"
KEPT = "kept"
"""The folder of what episodes looked like, for a policy that does not repeat itself."""
MOST = 100
"""Episodes of each condition, where no other number is asked for."""


@dataclass(frozen=True)
class AuditConfig:
    """Finds out which of its cameras a policy uses, and writes a page about it."""

    policy: checkpoint.PolicyName
    """A name of a policy, its folder, module:factory, or ws://HOST:PORT of one that is served."""
    out: Path
    """The folder for audit.html, audit.json, audit.md and the episodes; one for each audit."""
    task: TaskName | None = None
    """The task that the policy must be for; by default its own."""
    episodes: Count | None = None
    """Episodes of each condition, at most: the audit stops early when all is decided. By default
    100; with --along 60 of each axis."""
    seed: Seed = FIRST_SEED
    """The first episode's seed; the others count up, the same for every condition."""
    how: tuple[How, ...] = HOWS
    """The ways in which cameras are away; fewer take less time. Verdicts rest on ``dropped``, or on
    ``mean`` where the policy cannot drop a camera: what they need is always played."""
    along: tuple[str, ...] = ()
    """Instead: how much is too much, along axes such as ``third_a.pan=-20:20 third_a.blur=0:1
    light=0.3:2 third_a.delay=0:8``; also forward, right, up, tilt, zoom, noise, patch and loss."""
    pairs: Annotated[int, Range(int, 0, MOST_PAIRS)] = 4
    """Episodes that turned, to be shown beside the intact ones: films. Those of a policy that
    does not repeat itself are kept while its episodes are played, unless this is 0."""
    workers: ThreadsOrNone | None = None
    """Processes; by default one per core. 0 runs everything in this one."""
    json: str | None = None
    """Where to write the result, too; - is standard output."""
    wire: Path | None = None
    """How a served policy's names and shapes map to ours, a TOML file; madviz serve says it
    itself."""
    guard: bool = False
    """Plays every broken camera once more with the guard, which leaves it out until it works
    again; `madviz guard` fits it."""
    trust: bool = False
    """Whether the file of sb3:FILE@TASK may be loaded, which runs what is in it."""
    recording: Path | None = None
    """Recordings of your own robot, a LeRobot dataset, to answer to in place of playing: no
    success, but how far the action moves. By default on the held-out episodes."""


def audit(
    policy: str | Path | Policy,
    *,
    episodes: int = MOST,
    seed: int = FIRST_SEED,
    how: tuple[How, ...] = HOWS,
    workers: int | None = None,
    store: Store | None = None,
    progress: bool = False,
    guarded: str | Policy | None = None,
    kept: str = "",
) -> AuditFile:
    """Audits ``policy`` on the seeds ``seed`` to ``seed + episodes - 1``, or fewer where all is
    decided before.

    ``policy`` and ``workers`` as in ``madviz.evaluate``; ``how`` are the ways in which cameras are
    away. ``store`` is this audit's own: it answers for episodes that it has seen, and keeps the new
    ones. ``progress`` says on standard error what is planned and done. ``guarded`` is the policy
    with its guard, with which every broken camera is played once more. ``kept`` is a folder for
    what the episodes look like; '' keeps nothing.
    """
    seeds_of_run(seed, episodes)
    table, loaded = Table.opened(policy, store or Store(MEMORY), own=True)
    table.kept = kept
    plan = AuditPlan(Cameras(loaded.spec.streams, loaded.supports, how), episodes, seed)
    if progress:
        summary = plan_words(plan.episodes, plan.detectable)
        print(f"{len(plan.every)} conditions. {summary}", file=sys.stderr)

    def outcomes() -> Outcomes:
        return {condition: table.outcomes(condition) for condition in plan.every}

    while wanted := plan.wanted(outcomes()):
        table.play(wanted, workers, progress)
    try:
        env, _ = table.runner.opened(table.job(INTACT, 0))
        outside = table.outside(plan.every)
        document = audit_document(plan, outcomes(), loaded.spec, env.spec, outside)
        if guarded is not None:
            seeds = plan.seeds(document["intact"]["n"])
            other, with_guard = Table.opened(guarded, store or Store(MEMORY), own=True)
            note = guard_note(with_guard)
            with closing(other.runner):
                rows = guarded_rows(other, plan.cameras, seeds, workers, progress, note)
            document["guarded"] = rows
        return document
    finally:
        table.runner.close()


# --- The command ----------------------------------------------------------------------------


def run_audit(config: AuditConfig) -> AuditFile | AlongFile | RecordedAuditFile:
    """``madviz audit``; progress goes to standard error. Raises Interrupted at Ctrl-C, and
    UserError for a policy of another task, and for a folder whose audit began with another policy
    or seed."""
    trust(config.policy, config.trust)
    if config.recording is not None:
        return _audit_recording(config, config.recording)
    plain = with_wire(config.policy, config.wire)
    guarded = with_guard(plain, True) if config.guard else None
    if guarded is not None:
        checkpoint.load_policy(guarded)  # Before hours of episodes: its guard may not be fitted.
    reference = guarded if guarded and config.along else plain
    policy = checkpoint.load_policy(reference)
    if config.task not in (None, policy.spec.task):
        raise UserError(
            f"expected a policy for {config.task}, found {policy.spec.name!r} for "
            f"{policy.spec.task}; leave --task out, or name another policy"
        )
    if config.along and config.how != HOWS:
        raise UserError("--how is about cameras that are away; leave it out, or --along")
    _check_folder(config, policy)
    check_same_policy(config.out, policy, config.seed)
    kept = "" if not config.pairs or repeats_itself(reference, policy) else str(config.out / KEPT)
    with closing(Store(config.out / EPISODES)) as store:
        try:
            document, blocks = _measured(config, reference, guarded, policy, store, kept)
        except KeyboardInterrupt as stopped:
            raise Interrupted(command(config, given_away=False), signal_of(stopped)) from stopped
    _write(config.out, _name(config), document, blocks)
    return document


def _measured(
    config: AuditConfig,
    reference: str,
    guarded: str | None,
    policy: Policy,
    store: Store,
    kept: str,
) -> tuple[AuditFile | AlongFile, list[Block]]:
    """The document that ``config`` asks for, and its account. ``kept`` as in ``audit``."""
    runner = Runner()
    runner.adopt(reference, policy)
    again = command(config)

    def job(condition: Condition, seed: int) -> Job:
        return Job(reference, policy.spec.digest, condition, seed, kept)

    with closing(runner):
        if config.along:
            rows = along(
                reference,
                config.along,
                episodes=config.episodes or ALONG_EPISODES,
                seed=config.seed,
                workers=config.workers,
                store=store,
                progress=True,
                kept=kept,
            )
            pairs = along_pairs(rows, config.along, policy, job, config.pairs)
            return rows, along_account(rows, again, pair_blocks(pairs, runner))
        found = audit(
            reference,
            episodes=config.episodes or MOST,
            seed=config.seed,
            how=config.how,
            workers=config.workers,
            store=store,
            progress=True,
            guarded=guarded,
            kept=kept,
        )
        pairs = audit_pairs(found, policy, job, config.pairs)
        return found, account(found, again, pair_blocks(pairs, runner))


def _audit_recording(config: AuditConfig, folder: Path) -> RecordedAuditFile:
    """``madviz audit --recording``."""
    if config.along or config.guard or config.task:
        raise UserError(
            "expected --recording without --along, --guard and --task, found one of them; leave "
            f"it out ({LABEL})"
        )
    task = allow_recording(folder)
    recordings = recordings_of(task)
    policy = checkpoint.load_policy(with_wire(config.policy, config.wire))
    robot = checkpoint.robot_of_policy(config.policy)
    if robot is None and policy.spec.task != task:
        raise UserError(
            f"expected a policy for {task}, found {policy.spec.name!r} for {policy.spec.task}; "
            "train one with madviz train --recording, or say the task in its --wire file"
        )
    robot = robot or robot_for_any_policy(recordings)
    robot.check(recordings)
    _check_folder(config, policy)
    check_same_policy(config.out, policy, config.seed, f"{recordings.name} {recordings.whole}")
    audited = RecordedAudit(policy, robot, recordings, env_spec(task), config.how)
    document = recorded_audit(audited, config.episodes, progress=True)
    shown = ["--recording", recordings.name, "--policy", checkpoint.shown(config.policy)]
    blocks = recorded_account(document, command(config), shown)
    _write(config.out, "audit", document, blocks)
    return document


def _write(
    out: Path,
    name: str,
    document: AuditFile | AlongFile | RecordedAuditFile,
    blocks: list[Block],
) -> None:
    with saving(document, f"--out {out}"):
        write_json(out / f"{name}.json", document)
        write_bytes(out / f"{name}.md", markdown(blocks).encode())
        write_bytes(out / f"{name}.html", html(blocks).encode())
        if "axes" in document:
            write_bytes(out / "along.csv", along_csv(document).encode())


def _name(config: AuditConfig) -> str:
    return "along" if config.along else "audit"


def _check_folder(config: AuditConfig, policy: Policy) -> None:
    """Makes the folder. Raises UserError where it holds another policy's audit."""
    out = config.out
    if not out.exists():
        written_to(out, "--out")
        out.mkdir()
    if not out.is_dir():
        raise UserError(f"--out {out}: expected a folder, found a file; choose another name")
    for ending in ("html", "json", "md", "csv"):
        written_to(out / f"{_name(config)}.{ending}", "--out")
    for name in (EPISODES, FILE):
        written_to(out / name, "--out")
    for name in ("audit.json", "along.json"):
        before = read_json(out / name) if (out / name).is_file() else {}
        known = before.get("policy") if isinstance(before, dict) else None
        if before and known != policy.spec.name:
            raise UserError(
                f"--out {out}: expected a folder of its own for the audit of {policy.spec.name!r}, "
                f"found one of {known!r:.100}; choose another"
            )


def command(config: AuditConfig, given_away: bool = True) -> str:
    """The command line that makes the audit again, without secrets; if it is ``given_away``, with
    the last part alone of every path."""
    shown = replace(config, trust=False, workers=None, json=None) if given_away else config
    usual = AuditConfig("", config.out, seed=-1)  # The seed is said, also the default one.
    if config.recording is None:
        most = config.episodes or (ALONG_EPISODES if config.along else MOST)
        shown = replace(shown, episodes=most)
    else:
        usual = replace(usual, seed=config.seed, pairs=config.pairs)  # They say nothing there.
    asked = changed(shown, usual)
    asked["policy"] = (checkpoint.shown if given_away else without_secrets)(config.policy)
    asked["out"] = config.out
    if given_away:
        asked = {k: v.name if isinstance(v, Path) else v for k, v in asked.items()}
    return shlex.join(["madviz", "audit", *words_for(asked)])


def audit_words(found: AuditFile | AlongFile | RecordedAuditFile) -> str:
    """The text that the command prints."""
    if "label" in found:
        return "\n".join(recorded_words(found))
    if "axes" in found:
        return "\n".join(along_words(found))
    return "\n".join([*in_words(found), planned(found)])
