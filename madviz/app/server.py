"""``madviz explore``: the server, and everything that its visitors share."""

from __future__ import annotations

import gc
import socket
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import viser

from madviz.app.access import Gate, new_token, stays_here
from madviz.app.panels.policy import PolicyChoice
from madviz.app.rates import Rates
from madviz.app.toolkit import theme
from madviz.app.users import Users
from madviz.app.viser_patches import patch_sender
from madviz.envs.custom import allow_task
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.evaluation.live import Evaluator, Tally
from madviz.evaluation.store import Store
from madviz.policies import checkpoint
from madviz.session.replay import check_policies, differences, finder
from madviz.session.session import EnvFactory, Session
from madviz.session.session_file import KeptEpisode
from madviz.session.session_reader import read_kept
from madviz.system.processes import share_memory_between_threads
from madviz.training.job import TrainingJob
from madviz.types import CameraSpec, Environment, Policy, PolicySpec

DEFAULT_POLICY = "metaworld-hammer-mad-light"


@dataclass(frozen=True)
class ExploreConfig:
    """Serves the page: a policy at work, and cameras to take away from it."""

    policy: str | None = None
    """A name from ``madviz list``, a folder, or module:factory. By default the first that fits."""
    task: str | None = None
    """Offer only policies of this task, for example metaworld/hammer or, one of your own,
    module:factory."""
    port: int = 8080
    """Where to serve."""
    host: str = "127.0.0.1"
    """Which address to serve on; 0.0.0.0 lets other machines in, and then a token is needed."""
    token: bool = True
    """Whether a page that serves beyond this machine asks for the token that is printed."""
    present: bool = False
    """One simulation: whoever opens the presenter's address has the controls, all others watch."""
    visitors: int = 4
    """Visitors with a simulation of their own; more than that watch."""
    watchers: int = 50
    """Seats to watch from."""
    light: bool = False
    """Dark text on light ground; visitors can change it for themselves."""
    workers: int = 1
    """Processes that measure success in the background; 0 for none."""
    speed: float | None = 10.0
    """Decisions per second at the start; None for as fast as it goes."""
    replay: Path | None = None
    """A kept session: the page begins by living one of its episodes again."""
    episode: int | None = None
    """Which one of them, from 1; by default the last."""


def env_in_one_thread(
    task: str, render_profile: str, cameras: tuple[CameraSpec, ...] = ()
) -> Environment:
    """``make_env``, called by the thread that will own it; that thread computes on one core, as
    evaluation workers do. A policy's small matrices are no quicker on two, and on a busy machine a
    hundred times slower: threads that spin for each other."""
    if "torch" in sys.modules:
        import torch

        torch.set_num_threads(1)
    return make_env(task, render_profile, cameras)


class App:
    """A running page. ``stop`` frees the port and every simulation."""

    def __init__(
        self,
        policy: Policy | str,
        choices: Sequence[PolicyChoice],
        load_policy: Callable[[str], Policy],
        *,
        env_factory: EnvFactory = env_in_one_thread,
        rates: Rates | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        visitors: int = 4,
        watchers: int = 50,
        gate: Gate | None = None,
        light: bool = False,
        speed: float | None = 10.0,
        runs: Path = Path("runs"),
        script: KeptEpisode | None = None,
    ) -> None:
        """``policy`` may be a name for ``load_policy``: the page answers while it is being loaded.
        Trainings from the page get folders in ``runs``. ``port`` 0 takes a free one. ``gate`` with
        a presenter's token makes it a presentation. Raises UserError if the port is taken."""
        check_port(host, port)
        # A browser may leave while a frame is on its way to it; viser would warn about each.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        patch_sender()
        self.rates = rates or Rates()
        self.gate = gate or Gate(local=stays_here(host))
        with self.gate.guarding():
            self.server = viser.ViserServer(host=host, port=port, label="madviz", verbose=False)
        theme(self.server.gui, light)

        def new_session() -> Session:
            return Session(env_factory, policy, load_policy, speed=speed, script=script)

        self.training = TrainingJob(runs)
        shared = (choices, self.rates, self.training)
        presents = self._presents if self.gate.present else None
        self.users = Users(self.server, new_session, *shared, visitors, watchers, presents)

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
        self.users.close()
        self.server.stop()
        self.rates.close()
        self.training.close()


def explore(config: ExploreConfig | None = None) -> None:
    """Serves the page until Ctrl-C. Raises UserError for a policy, task or port that won't do."""
    config = config or ExploreConfig()
    check_port(config.host, config.port)
    app = open_app(config)
    for what, address in app.addresses().items():
        print(f"{what} {address}", flush=True)
    print("(Ctrl-C ends it)", flush=True)
    try:
        threading.Event().wait()
    finally:
        app.stop()


def open_app(config: ExploreConfig) -> App:
    """The page as configured, running."""
    share_memory_between_threads()
    # Python threads take turns of 5 ms by default; a visitor's click crosses four of them.
    sys.setswitchinterval(0.001)
    allow_task(config.task)
    choices = policy_choices(config.task)
    script, loaded = kept_script(config)
    name = next(iter(loaded), None) or config.policy or first_choice(choices, config.task)
    if name not in loaded and not checkpoint.is_folder(name):
        loaded[name] = checkpoint.load_policy(name)
    # Loading a folder takes seconds, most of them spent on importing torch. Looking at it takes
    # none, and a browser can use those seconds to open the page.
    spec = loaded[name].spec if name in loaded else checkpoint.describe(name).spec

    def load(wanted: str) -> Policy:
        if wanted not in loaded:
            loaded[wanted] = checkpoint.load_policy(wanted)
            settle()
        return loaded[wanted]

    def reference(spec: PolicySpec) -> str:
        return next((key for key, one in loaded.items() if one.spec == spec), spec.name)

    def evaluator(listener: Callable[[Tally], None]) -> Evaluator:
        return Evaluator(config.workers, Store(), listener)

    if name not in [choice.name for choice in choices]:
        choices = [PolicyChoice(name, spec.name), *choices]
    return App(
        name,
        choices,
        load,
        rates=Rates(shipped_rates, evaluator if config.workers else None, reference),
        host=config.host,
        port=config.port,
        visitors=config.visitors,
        watchers=config.watchers,
        gate=gate_for(config),
        light=config.light,
        speed=config.speed,
        script=script,
    )


def settle() -> None:
    """What is there now stays; looking through it again for garbage after every visit would take a
    fifth of a second from everybody else."""
    gc.collect()
    gc.freeze()


def gate_for(config: ExploreConfig) -> Gate:
    """The tokens that a configuration asks for, new ones at every start."""
    local = stays_here(config.host)
    guarded = config.token and not local
    return Gate(new_token() if guarded else None, new_token() if config.present else None, local)


def with_token(address: str, token: str | None) -> str:
    """An address that opens the page for whoever has it."""
    return f"{address}/?token={token}" if token else address


def reached_at(host: str) -> str:
    """How other machines call ``host``. For 0.0.0.0 that is the address from which this machine
    would reach others; asking for it sends nothing."""
    if host != "0.0.0.0":
        return host
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("10.255.255.255", 9))
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])


def kept_script(config: ExploreConfig) -> tuple[KeptEpisode | None, dict[str, Policy]]:
    """The episode to live again, if there is one, and all its policies by name, the first one
    first. Says what is known to be different here. Raises UserError for a file that won't do."""
    if config.replay is None:
        return None, {}
    kept = read_kept(config.replay)
    script = kept.episode(config.episode)
    find = finder(() if config.policy is None else (config.policy,))
    check_policies(script, find)
    for difference in differences(script, kept, find):
        print(f"madviz: it may come out differently: {difference}", file=sys.stderr)
    return script, {policy.name: find(policy) for policy in script.policies}


def shipped_rates(spec: PolicySpec) -> dict:
    """The subsets of a policy's evaluation.json; empty where it has none."""
    folder = checkpoint.policy_folders().get(spec.name)
    return (checkpoint.shipped_evaluation(folder) or {}).get("subsets", {}) if folder else {}


def policy_choices(task: str | None) -> list[PolicyChoice]:
    """The policies a visitor can swap between, those of ``task`` only if it is given."""
    listed, _ = checkpoint.list_policies()
    fitting = [one for one in listed if task in (None, one["task"])]
    return [
        PolicyChoice(
            one["name"],
            f"{one['task'].split('/')[-1]} · {one['method']} · {one['setting']} · {one['recipe']}",
        )
        for one in fitting
    ]


def first_choice(choices: Sequence[PolicyChoice], task: str | None) -> str:
    """The default policy, or the first there is. Raises UserError where there is none."""
    names = [choice.name for choice in choices]
    if DEFAULT_POLICY in names:
        return DEFAULT_POLICY
    if not names:
        what = f"policy for {task!r}" if task else "policy"
        raise UserError(f"no {what} found; name one with --policy, or train one: madviz train")
    return names[0]


def check_port(host: str, port: int) -> None:
    """Raises UserError if ``port`` is taken; viser would silently take the next one."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise UserError(
                f"port {port} on {host} cannot be served ({error.strerror}); choose another "
                "with --port"
            ) from error
