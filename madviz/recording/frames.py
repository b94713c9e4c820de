"""The frames of an episode that nobody watches: of every step the last one."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from madviz.errors import UserError, parts_of
from madviz.policies.guarded import reference_to
from madviz.session.commands import Play
from madviz.session.frame import Frame, NoFrame
from madviz.session.replay import Finder, check_episode
from madviz.session.session import Session
from madviz.session.session_file import SavedEpisode
from madviz.types import Environment, Policy


def frames(session: Session, steps: int | None) -> Iterator[Frame]:
    """The frames of one episode, from step 0 to its end or to step ``steps``: of every step the
    last one, after whatever came by itself. Raises UserError where the session stops."""
    arrived: deque[Frame | NoFrame] = deque()
    session.subscribe(arrived.append)
    newest: Frame | None = None
    while newest is None or not (newest.ended or newest.world.step == steps):
        session.tick(0.0)
        while arrived:
            frame = arrived.popleft()
            error = frame.error if isinstance(frame, NoFrame) else frame.pace.error
            if error or isinstance(frame, NoFrame):
                raise UserError(f"the episode stopped: {parts_of(error)[0]}")
            if newest is not None and frame.world.step > newest.world.step:
                yield newest
                if newest.world.step == steps:
                    return
            newest = frame
    yield newest


def session_of(
    env: Environment, policy: Policy, seed: int, script: SavedEpisode | None, find: Finder
) -> Session:
    """A session in ``env`` that runs as fast as it can. Raises as ``check_episode`` does."""
    if script is not None:
        check_episode(script, find, env)
    wanted = {reference_to(one.name): one for one in (script.policies if script else ())}

    def load(name: str) -> Policy:
        return find(wanted[name])

    session = Session(lambda *_: env, policy, load, seed=seed, speed=None, script=script)
    if script is not None:
        session.send(Play())  # A session with a script starts paused.
    return session
