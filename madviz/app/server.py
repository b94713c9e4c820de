"""``madviz explore``: the server, and everything that its visitors share."""

from __future__ import annotations

import gc
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import viser

from madviz.app.access import Gate
from madviz.app.connection import guard
from madviz.app.forking import DEFAULT_POLICY, prepare
from madviz.app.layout import Shared
from madviz.app.panels.policy import PolicyChoice, purpose
from madviz.app.session_maker import SessionMaker
from madviz.app.success_rates import SuccessRates
from madviz.app.toolkit import theme
from madviz.app.users import MOST_WAITING, Limits, Users
from madviz.app.viser_patches import patch_sender
from madviz.envs.custom import allow_task
from madviz.envs.registry import TaskName, check_task
from madviz.errors import UserError
from madviz.measure.episodes import check_begin
from madviz.measure.live import Evaluator, Tally
from madviz.measure.store import Store
from madviz.observation.condition import Condition
from madviz.observation.displacement import MoveCamera
from madviz.observation.grammar import parse_condition
from madviz.observation.schedule import Event
from madviz.policies import checkpoint
from madviz.policies.checkpoint import PolicyName
from madviz.policies.guarded import is_guarded, reference_to, unguarded
from madviz.policies.listing import list_policies
from madviz.policies.no_policy import NONE_LABEL, is_no_policy, without_policy
from madviz.policies.sb3 import trust
from madviz.recorded.known import allow_recording, recordings_of
from madviz.session.commands import Command, SetCamera, SetSchedule
from madviz.session.live_session import LiveSession
from madviz.session.process import References, SessionProcess
from madviz.session.replay import check_policies, differences, finder
from madviz.session.session_file import SavedEpisode
from madviz.session.session_reader import read_session
from madviz.subsets import cameras_of
from madviz.system.hosts import (
    check_port,
    machine_token,
    new_token,
    reached_at,
    stays_here,
    with_token,
)
from madviz.system.numbers import (
    Count,
    CountOrNone,
    Port,
    Rate,
    Seed,
    ThreadsOrNone,
    check_numbers,
)
from madviz.system.processes import limit_heaps
from madviz.system.streams import say, telling
from madviz.types import PolicySpec
from madviz.wire.reference import with_wire


@dataclass(frozen=True)
class ExploreConfig:
    """Serves the page: a policy at work, and cameras to take away from it."""

    policy: PolicyName | None = None
    """A name of a policy, its folder, module:factory, or ws://HOST:PORT of one that is served. By
    default MAD on hammer, or the first that fits."""
    task: TaskName | None = None
    """Offer only policies of this task, for example metaworld/hammer or, one of your own,
    module:factory."""
    port: Port = 8080
    """Where to serve."""
    host: str = "127.0.0.1"
    """Which address to serve on; 0.0.0.0 lets other machines in, and then a token is needed."""
    token: bool = True
    """Whether a page that serves beyond this machine asks for the token that is printed; also one
    that does not, where MADVIZ_TOKEN has a token."""
    present: bool = False
    """One simulation: whoever opens the presenter's address has the controls, all others watch."""
    visitors: Count = 4
    """Visitors with a simulation of their own; more than that watch."""
    watchers: CountOrNone = 50
    """Visitors who watch, at most."""
    light: bool = False
    """Dark text on light ground; visitors can change it for themselves."""
    workers: ThreadsOrNone = 1
    """Processes that measure success in the background; 0 for none."""
    speed: Rate | None = 10.0
    """Decisions per second at the start; None for as fast as it goes."""
    replay: Path | None = None
    """A saved session: the page begins with one of its episodes again."""
    episode: Count | None = None
    """Which one of them, from 1; by default the last."""
    wire: Path | None = None
    """How a served policy's names and shapes map to ours, a TOML file; madviz serve says it
    itself."""
    seed: Seed | None = None
    """The scene to begin with."""
    condition: str = "all"
    """How the cameras are when the page opens, as in `madviz compare --conditions`: first=off,
    third_a=noise:0.5 or third_a.pan=-11."""
    trust: bool = False
    """Whether the file of sb3:FILE@TASK may be loaded, which runs what is in it."""
    recording: Path | None = None
    """Recordings of your own robot, a LeRobot dataset: it plays as it was, and --policy beside
    it says what it would do."""


class App:
    """A running page. ``stop`` frees the port and every simulation."""

    def __init__(
        self,
        new_session: Callable[[], LiveSession],
        shared: Shared,
        limits: Limits | None = None,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        gate: Gate | None = None,
        light: bool = False,
    ) -> None:
        """``new_session`` makes a simulation that is not started yet. ``port`` 0 takes a free one.
        ``gate`` None lets everybody in; one with a presenter's token makes the page a presentation.
        ``light``: dark text on light ground. Raises UserError if the port is taken."""
        check_port(host, port)
        # A browser may leave while a frame is on its way to it; viser would warn about each.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        # And about each value of another type than a message has, with the value: 64 KB of log.
        warnings.filterwarnings("ignore", message=r"\[viser\] ")
        patch_sender()
        self.shared = shared
        limits = limits or Limits()
        self.gate = gate or Gate(local=stays_here(host))
        self.gate.most = limits.visitors + limits.watchers + MOST_WAITING
        with self.gate.guarding():
            self.server = viser.ViserServer(host=host, port=port, label="madviz", verbose=False)
        guard(self.server)
        theme(self.server.gui, light)
        presents = self._presents if self.gate.present else None
        self.users = Users(self.server, new_session, shared, limits, presents)
        self.gate.serves = self.users.kept.answer

    def _presents(self, client: viser.ClientHandle) -> bool:
        return self.gate.presents(self.server, client.client_id)

    @property
    def url(self) -> str:
        """The page, without any token."""
        host = self.server.get_host()
        shown = "127.0.0.1" if host == "0.0.0.0" else host
        return f"http://{shown}:{self.server.get_port()}"

    def addresses(self) -> dict[str, str]:
        """Who opens what: addresses with the tokens they need."""
        beyond = self.url
        if not stays_here(self.server.get_host()):
            beyond = f"http://{reached_at(self.server.get_host())}:{self.server.get_port()}"
        if self.gate.present is None:
            return {"madviz is at": with_token(beyond, self.gate.visit)}
        return {
            "present at": with_token(self.url, self.gate.present),
            "watch at": with_token(beyond, self.gate.visit),
        }

    def stop(self) -> None:
        """Frees the port, every simulation, workers and a training's process."""
        self.users.close()
        self.server.stop()
        self.shared.audit.close()
        self.shared.rates.close()
        self.shared.training.close()


def explore(config: ExploreConfig | None = None) -> None:
    """Serves the page until Ctrl-C. Raises UserError for a policy, task or port that won't do."""
    config = config or ExploreConfig()
    check_numbers(config)
    if config.task is not None:
        allow_task(config.task)
        check_task(config.task)
    check_port(config.host, config.port)
    gc.freeze()  # What is imported stays: no visitor waits while it is gone through for garbage.
    try:
        _serve(config)
    finally:
        gc.unfreeze()


def _serve(config: ExploreConfig) -> None:
    app = open_app(config)
    try:
        with telling():
            for what, address in app.addresses().items():
                print(f"{what} {address}", flush=True)
            print("(Ctrl-C ends it)", flush=True)
        while True:  # A signal that the system gave to another thread is noticed within a second.
            time.sleep(1.0)
    finally:
        app.stop()


def open_app(config: ExploreConfig) -> App:
    """The page as configured, running."""
    limit_heaps()
    # Python threads take turns of 5 ms by default; a click crosses three on its way back.
    sys.setswitchinterval(0.001)
    allow_task(config.task)
    trust(config.policy, config.trust)
    config = with_recording(config)
    choices = policy_choices(config.task)
    script, given = saved_episode(config)
    named = with_wire(config.policy or "", config.wire)
    name = next(iter(given), None) or named or first_choice(choices, config.task)
    if not given and checkpoint.is_folder(name):
        given = {name: described(name)}
    # A policy of one's own takes its time to load; the fork server starts beside it.
    prepare(given[name].task if given else "")
    given = given or {name: described(name)}
    references = References()
    for reference, spec in given.items():
        references.note(reference, spec)
    if name not in [choice.name for choice in choices]:
        label = NONE_LABEL if is_no_policy(name) else checkpoint.shown(name)
        choices = [PolicyChoice(name, label, given[name].task), *choices]
    make = SessionMaker(
        name,
        named or None,
        config.task,
        config.speed,
        script,
        trusted=config.trust,
        seed=config.seed,
        begins=beginning(config, given[name]),
        recording=config.recording,
    )

    def new_session() -> SessionProcess:
        return SessionProcess(make, references)

    def evaluator(listener: Callable[[Tally], None]) -> Evaluator:
        return Evaluator(config.workers, Store(), listener)

    def shipped(spec: PolicySpec) -> dict:
        return shipped_rates(references.name_of(spec), spec)

    rates = SuccessRates(shipped, evaluator if config.workers else None, references.name_of)
    return App(
        new_session,
        Shared(choices, rates, greets=script is None and config.seed is None),
        Limits(config.visitors, config.watchers),
        host=config.host,
        port=config.port,
        gate=gate_for(config),
        light=config.light,
    )


def with_recording(config: ExploreConfig) -> ExploreConfig:
    """``config`` with the task of its recordings, and what stands in where it has no policy. Says
    which episodes are left out. Raises UserError beside a saved session or another task."""
    if config.recording is None:
        return config
    if config.replay is not None or config.task is not None:
        raise UserError(
            "expected --recording without --replay or --task, found one of them; leave it out"
        )
    task = allow_recording(config.recording)
    for line in recordings_of(task).left_out:
        say(f"madviz: left out: {line}")
    robot = checkpoint.robot_of_policy(config.policy) if config.policy else None
    first = 0
    if robot is not None:
        recordings = recordings_of(task)
        robot.check_units(recordings)
        unseen = robot.unseen(recordings)
        first = next((i for i, one in enumerate(recordings.episodes) if one.index in unseen), 0)
    policy = config.policy or without_policy(task)
    seed = first if config.seed is None else config.seed
    return replace(config, task=task, policy=policy, seed=seed)


def gate_for(config: ExploreConfig) -> Gate:
    """The tokens that a configuration asks for: new ones at every start, or the machine's own."""
    local = stays_here(config.host)
    visit = machine_token() or (None if local else new_token())
    return Gate(visit if config.token else None, new_token() if config.present else None, local)


def beginning(config: ExploreConfig, spec: PolicySpec) -> tuple[Command, ...]:
    """The commands that make the cameras of a policy as ``--condition`` says. Raises UserError for
    a condition that is none, one that begins after the end, and beside a saved session."""
    if config.replay is not None and (config.seed is not None or config.condition != "all"):
        raise UserError(
            "expected a saved session to have a seed and switches of its own, found --seed or "
            "--condition beside --replay; leave them out"
        )
    condition = parse_condition(config.condition, cameras_of(spec.streams))
    ablation = condition.noticed(spec.streams).ablation(spec.streams)
    intact = Condition("all").ablation(spec.streams)
    changed = {
        name: state for name, state in ablation.cameras.items() if state != intact.camera(name)
    }
    check_begin(condition.begin, spec.task, spec.horizon)
    if condition.begin:
        events = [
            Event(condition.begin, camera, state.input == "off", state.occlusion)
            for camera, state in changed.items()
        ]
        return (SetSchedule(tuple(events)),)
    switches = [SetCamera(name, state) for name, state in changed.items()]
    return (*switches, *(MoveCamera(name, move) for name, move in ablation.moves.items()))


def described(policy: str) -> PolicySpec:
    """The specification of ``policy``. A folder has it without its weights or torch; the
    simulation's process loads both."""
    if checkpoint.is_folder(policy):
        return checkpoint.describe(policy).spec
    return checkpoint.load_policy(policy).spec


def saved_episode(config: ExploreConfig) -> tuple[SavedEpisode | None, dict[str, PolicySpec]]:
    """The episode to replay, if there is one, and all its policies by reference, the first one
    first. Says what is known to be different here. Raises UserError for a file that won't do."""
    if config.replay is None:
        return None, {}
    saved = read_session(config.replay)
    script = saved.episode(config.episode)
    named = with_wire(config.policy or "", config.wire)
    find = finder((named,) if named else ())
    check_policies(script, find)
    for difference in differences(script, saved, find):
        say(f"madviz: it may come out differently: {difference}")
    return script, {reference_to(policy.name): find(policy).spec for policy in script.policies}


def shipped_rates(reference: str, spec: PolicySpec) -> dict:
    """The subsets of the evaluation.json of the policy that ``load_policy`` knows by ``reference``;
    empty where it is no folder, has other weights than ``spec`` or none, or a broken one."""
    try:
        folder = checkpoint.describe(unguarded(reference))
        # A guard changes nothing where no camera fails, as in what is shipped.
        same = is_guarded(reference) or folder.spec.digest == spec.digest
        return dict(checkpoint.own_evaluation(folder)["subsets"]) if same else {}
    except UserError:
        return {}  # ``policy_choices`` says what is broken.


def policy_choices(task: str | None) -> list[PolicyChoice]:
    """The policies a visitor can swap between, those of ``task`` only if it is given; else also
    those that are broken, last, and why."""
    listed, broken = list_policies()
    fitting = [one for one in listed if task in (None, one["task"])]
    choices: list[PolicyChoice] = []
    for one in fitting:
        label = purpose(one["method"], one["setting"], one["recipe"])
        if any((other.task, other.label) == (one["task"], label) for other in choices):
            label += f" · {one['name']}"
        choices.append(PolicyChoice(one["name"], label, one["task"]))
    if task is None:
        for each in broken:
            why = each["error"].removeprefix(each["path"]).lstrip("/")
            label = f"{each['name']} · broken: {why:.80}"
            choices.append(PolicyChoice(each["name"], label, broken=True))
    return choices


def first_choice(choices: Sequence[PolicyChoice], task: str | None) -> str:
    """The default policy, or the first there is. Raises UserError where there is none."""
    names = [choice.name for choice in choices if not choice.broken]
    if DEFAULT_POLICY in names:
        return DEFAULT_POLICY
    if not names:
        what = f"policy for {task!r}" if task else "policy"
        raise UserError(f"no {what} found; name one with --policy, or train one: madviz train")
    return names[0]
