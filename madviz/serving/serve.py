"""``madviz serve``: a policy for other programs, by websocket.

Both protocols (``madviz.wire.protocols``) are spoken on one port. A vla-eval client speaks first,
and so does madviz; a client of openpi waits to be greeted. So the server listens for half a second,
and then greets.

    GET ws://127.0.0.1:8000    this machine alone, until --host says otherwise
    Origin: any                refused: a browser says it, and no page has business here
    beyond this machine        a token, as ?token=T or as Authorization: Api-Key T

One look is answered at a time, on one thread, as evaluations compute: the same look gives the same
bits.

A policy that learned from recordings (robot.json beside it) is served in its robot's units.
"""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve
from websockets.typing import Subprotocol

from madviz.envs.registry import env_spec
from madviz.errors import UserError
from madviz.measure.episodes import one_thread
from madviz.policies import checkpoint
from madviz.policies.guarded import with_guard
from madviz.policies.sb3 import trust
from madviz.recorded.known import is_recording, recordings_of
from madviz.recorded.robot import Robot, robot_document, robot_for_any_policy
from madviz.serving.dry_run import dry_run
from madviz.serving.episodes import BadLook, ServedEpisodes
from madviz.system.hosts import new_token, port_error, same_token, stays_here, with_token
from madviz.system.numbers import Port, check_numbers
from madviz.types import EnvSpec, Policy
from madviz.wire.codec import MOST_BYTES, BadMessage, pack, unpack
from madviz.wire.connection import OURS
from madviz.wire.protocols import BOXED, VERSION
from madviz.wire.protocols import OURS as FACTS
from madviz.wire.wiring import served

LISTEN = 0.5
"""Seconds in which a vla-eval client has spoken."""
MOST_CLIENTS = 32
NO_PICTURES = {"state", "prompt", "episode"}
"""Words of a look of openpi that are no pictures."""
LEAST = 1024
"""Values that a picture has, at least."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ServeConfig:
    """Serves a policy to other programs, in the protocols of vla-eval and openpi."""

    policy: checkpoint.PolicyName
    """A name of a policy, its folder, or module:factory."""
    port: Port = 8000
    """Where to serve; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Which address to serve on; 0.0.0.0 lets other machines in, and then a token is needed."""
    guard: bool = False
    """A camera that the guard finds failing is left out until it works again; `madviz
    guard` fits it."""
    trust: bool = False
    """Loads the file of sb3:FILE@TASK, which runs what is in it."""
    token: bool = True
    """Whether clients beyond this machine need the token that is printed."""
    check: Path | None = None
    """Serves nothing: answers to every frame of one held-out episode of these recordings, a LeRobot
    dataset of the policy's robot, and says what a robot would have met."""


class PolicyServer:
    """A running server. ``close`` frees the port."""

    def __init__(
        self,
        policy: Policy,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        robot: Robot | None = None,
    ) -> None:
        """``robot``: the robot whose recordings ``policy`` learned from. Raises UserError for a
        place that cannot be served."""
        self._policy = policy
        self._token = token
        self._robot = robot
        self._state_dim = len(robot.state_names) if robot else self._env().state_dim
        self._action_dim = len(robot.action_names) if robot else self._env().action_dim
        self._facts = served(policy)
        if robot is not None:
            self._facts["robot"] = robot_document(robot)
        self._computing = threading.Lock()
        self._clients = threading.Semaphore(MOST_CLIENTS)
        self._connections: set[ServerConnection] = set()
        self._ending = False
        try:
            self._server: Server = serve(
                self._talk,
                host,
                port,
                subprotocols=[OURS],
                select_subprotocol=_chosen,
                process_request=self._admit,
                compression=None,
                max_size=MOST_BYTES,
                close_timeout=1.0,
                ping_interval=None,
            )
        except (OSError, UnicodeError) as error:
            raise port_error(host, port, error) from error
        self.address = f"ws://{host}:{self._server.socket.getsockname()[1]}"

    def _env(self) -> EnvSpec:
        return env_spec(self._policy.spec.task, self._policy.spec.render_profile)

    def run(self) -> None:
        """Serves until ``close``."""
        self._server.serve_forever()

    def start(self) -> PolicyServer:
        """``run`` in a thread of its own."""
        threading.Thread(target=self.run, name="madviz-serve", daemon=True).start()
        return self

    def close(self) -> None:
        """No more clients; those that are there are hung up."""
        self._ending = True
        self._server.shutdown()
        for connection in tuple(self._connections):
            connection.close(1001, "the server ends")

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        if request.headers.get("Origin") is not None:
            return connection.respond(HTTPStatus.FORBIDDEN, "This is for programs, not for pages.")
        if self._token is None:
            return None
        asked = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        said = asked or request.headers.get("Authorization", "").removeprefix("Api-Key ")
        if same_token(said, self._token):
            return None
        return connection.respond(HTTPStatus.UNAUTHORIZED, "Expected the token that was printed.")

    def _talk(self, connection: ServerConnection) -> None:
        if not self._clients.acquire(blocking=False):
            connection.close(1013, "too many clients")
            return
        episodes = ServedEpisodes(self._policy, self._state_dim, self._robot)
        self._connections.add(connection)
        try:
            if self._ending:  # It was greeted while the others were hung up.
                return
            _keep_alive(connection.socket)
            first = _first_words(connection)
            if first is None:
                self._talk_openpi(connection, episodes)
            else:
                self._talk_vla_eval(connection, episodes, first)
        except ConnectionClosed:
            pass
        except Exception:
            log.exception("a client was hung up")
            connection.close(1011, "the policy failed; see the server's log")
        finally:
            self._connections.discard(connection)
            self._clients.release()
            episodes.close()

    def _talk_vla_eval(
        self, connection: ServerConnection, episodes: ServedEpisodes, data: bytes | str
    ) -> None:
        while True:
            message: dict[str, Any] = {}
            try:
                found = unpack(data)
                message = found if isinstance(found, dict) else {}
                kind = message.get("type")
                payload = message.get("payload")
                if not isinstance(payload, dict):
                    raise BadLook("expected a message with type and payload, found another")
                answer = self._answer(episodes, str(kind), payload)
            except (BadMessage, BadLook, UserError) as bad:
                answer = "error", {"error": str(bad)}
            if answer is not None:
                back = {"type": answer[0], "payload": answer[1], "seq": message.get("seq", 0)}
                connection.send(pack({**back, "timestamp": 0.0}, "vla-eval"))
            data = connection.recv()

    def _answer(
        self, episodes: ServedEpisodes, kind: str, payload: dict[str, Any]
    ) -> tuple[str, dict[str, Any]] | None:
        if kind == "hello":
            return "hello", self._greeting()
        if kind == "episode_start":
            seed = payload.get("seed")
            if seed is not None and (not isinstance(seed, int) or seed < 0):
                raise BadLook(f"expected a whole number as the seed, found {seed!r:.40}")
            episodes.begin(seed or 0)
        elif kind == "observation":
            state = payload.get("state", payload.get("states"))
            with self._computing, one_thread():
                action = episodes.act(payload.get("images"), state, payload.get(BOXED) is True)
                return "action", {"actions": action}
        elif kind == "episode_end":
            episodes.close()
        else:
            raise BadLook(f"expected hello, episode_start or observation, found {kind!r:.40}")
        return None

    def _talk_openpi(self, connection: ServerConnection, episodes: ServedEpisodes) -> None:
        connection.send(pack({FACTS: self._facts}, "openpi"))
        while True:
            data = connection.recv()
            try:
                look = unpack(data)
                if not isinstance(look, dict):
                    raise BadLook("expected a table, found something else")
                images = self._beside(look)
                with self._computing, one_thread():
                    episodes.enter(look)
                    action = episodes.act(images, look.get("state"), look.get(BOXED) is True)
            except (BadMessage, BadLook, UserError) as bad:
                connection.send(str(bad))  # A text is how this protocol says that it failed.
                connection.close(1011, "see the text before")
                return
            connection.send(pack({"actions": action[None]}, "openpi"))

    def _beside(self, look: dict[str, Any]) -> dict[str, Any]:
        """The pictures of ``look`` by name. Raises BadLook for some that lie deeper in it."""
        streams = self._policy.spec.streams
        images = {name: value for name, value in look.items() if self._shows(name, value)}
        if any(look.get(stream) is None for stream in streams):  # One may have another name.
            others = look.keys() - images.keys() - NO_PICTURES
            images |= {name: look[name] for name in others if _packed(look[name])}
        for name, value in look.items():
            if name not in images and self._hides(value):
                raise BadLook(
                    f"expected pictures beside 'state', found them in {name!r:.60}; send each "
                    f"under its own name: {', '.join(self._policy.spec.streams)}"
                )
        return images

    def _hides(self, value: Any) -> bool:
        """True for a table or a list with pictures in it, at any depth."""
        inside = dict(enumerate(value)) if isinstance(value, list) else value
        return isinstance(inside, dict) and any(
            self._shows(name, each) or self._hides(each) for name, each in inside.items()
        )

    def _shows(self, name: str | int, value: Any) -> bool:
        """True for what a client means as a picture, also under a name that no camera has."""
        deep = isinstance(value, np.ndarray) and value.ndim >= 3
        return deep or name in self._policy.spec.streams

    def _greeting(self) -> dict[str, Any]:
        numbers = {"name": "actions", "dims": self._action_dim, "format": "raw"}
        state = {"name": "state", "dims": self._state_dim, "format": "raw"}
        return {
            "harness_version": "madviz",
            "protocol_version": VERSION,
            "model_server": self._policy.spec.name,
            "capabilities": {},
            "action_spec": {"actions": {**numbers, "range": self._range()}},
            "observation_spec": {
                "images": {"name": "images", "dims": 0, "format": "rgb"},
                "state": state,
            },
            FACTS: self._facts,
        }

    def _range(self) -> list[float]:
        """The least and the largest number of an action."""
        if self._robot is None:
            return [-1.0, 1.0]
        return [min(self._robot.actions.low), max(self._robot.actions.high)]


def _packed(value: Any) -> bool:
    """True for what may be a picture in a form that no policy takes: bytes, lists of rows, grey."""
    if isinstance(value, list):
        return bool(value) and isinstance(value[0], list) and len(value) * len(value[0]) >= LEAST
    if isinstance(value, bytes):
        return len(value) >= LEAST
    return isinstance(value, np.ndarray) and value.ndim == 2 and value.size >= LEAST


def _chosen(connection: ServerConnection, offered: Sequence[Subprotocol]) -> Subprotocol | None:
    return OURS if OURS in offered else None


def _keep_alive(line: socket.socket) -> None:
    """Has the system hang up a client whose machine is gone without a word, after two minutes."""
    line.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 60), ("TCP_KEEPINTVL", 20), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, name):  # Not on every platform.
            line.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def _first_words(connection: ServerConnection) -> bytes | str | None:
    """The first message that a client sends by itself; None where it waits to be greeted."""
    if connection.subprotocol == OURS:
        return connection.recv()
    try:
        return connection.recv(LISTEN)
    except TimeoutError:
        return None


def run_serve(config: ServeConfig) -> None:
    """``madviz serve``: until Ctrl-C. Raises UserError for a policy or a place that won't do."""
    check_numbers(config)
    token = new_token() if config.token and not stays_here(config.host) else None
    trust(config.policy, config.trust)
    policy = checkpoint.load_policy(with_guard(config.policy, config.guard))
    robot = checkpoint.robot_of_policy(config.policy)
    if robot is None and is_recording(policy.spec.task):
        # It takes and gives scaled numbers, as all policies of recordings do in one process.
        robot = robot_for_any_policy(recordings_of(policy.spec.task))
    if config.check is not None:
        print("\n".join(dry_run(policy, robot, config.check)))
        return
    server = PolicyServer(policy, config.host, config.port, token, robot)
    print(f"{policy.spec.name} is at {with_token(server.address, token)}")
    print("(Ctrl-C ends it)", flush=True)
    try:
        server.run()
    finally:
        server.close()
