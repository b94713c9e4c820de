"""A LeRobot dataset (v3), opened: its episodes, their numbers and their pictures.

    recordings = open_recordings(Path("bench"))
    states, actions = recordings.numbers(3)        # (T, S), (T, A)
    frames = recordings.frames(3, 84)              # (T, V, 84, 84, 3), mapped from the cache

Opening reads the numbers of all episodes once and no pictures. An episode that lacks something is
named in ``left_out``, and the others can be used.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

from madviz.errors import UserError
from madviz.recorded.cache import CacheError, packed
from madviz.recorded.description import Description, RecordedCamera, read_description
from madviz.recorded.episodes import Location, RecordedEpisode, find_episodes, numbers_of
from madviz.recorded.films import film_pictures, table_pictures
from madviz.recorded.scaling import Scaling, scaling_of, spread_of
from madviz.recorded.split import held_out
from madviz.types import Array


@dataclass(frozen=True, eq=False)
class Recordings:
    """Episodes are named by their index in the dataset; indices of those left out are missing."""

    path: Path
    name: str
    """The folder's name."""
    fps: float
    cameras: tuple[RecordedCamera, ...]
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    episodes: tuple[RecordedEpisode, ...]
    """The whole ones."""
    left_out: tuple[str, ...]
    """One line for each episode, camera or list of names that is left out: which, and why."""
    _description: Description = field(repr=False)
    _locations: dict[int, Location] = field(repr=False)

    def numbers(self, episode: int) -> tuple[Array, Array]:
        """States (T, S) and actions (T, A) of the episode with this index, float32, raw units."""
        location = self._location(episode)
        return numbers_of(self._description, location)

    def digest(self, episode: int) -> str:
        """16 hexadecimal digits that stand for the numbers of the episode with this index."""
        return _digest(self, episode)

    @property
    def whole(self) -> str:
        """16 hexadecimal digits that stand for the numbers of all episodes."""
        each = "".join(self.digest(one.index) for one in self.episodes)
        return hashlib.sha256(each.encode()).hexdigest()[:16]

    def frames(self, episode: int, size: int) -> Array:
        """(T, V, size, size, 3) uint8, letterboxed: a read-only map of the cache. The first call
        decodes. Raises UserError if a picture is broken or the cache cannot be written."""
        location = self._location(episode)
        sources = [location.data, *(film for film, _ in location.films.values())]
        facts = (
            location.first,
            location.steps,
            sorted(location.films.items()),
            self.cameras,
            self.fps,
        )
        shape = (location.steps, len(self.cameras), size, size, 3)
        name = f"episode-{episode:06d}"
        return packed(name, sources, facts, shape, self._pictures(location))

    def fault(self, episode: int, size: int) -> str:
        """Why the pictures of an episode cannot be decoded, in one line; '' where they can be.
        Raises CacheError where they cannot be kept."""
        try:
            self.frames(episode, size)
        except CacheError:
            raise
        except UserError as error:
            return f"episode {episode}: {error}"
        return ""

    def prepared(self, size: int, done: Callable[[int], None] = lambda _: None) -> Recordings:
        """These recordings with all pictures decoded; episodes that cannot be are left out, too.
        ``done`` gets the number of episodes that are ready. Raises UserError if none is left."""
        broken: dict[int, str] = {}
        for number, episode in enumerate(self.episodes, start=1):
            if fault := self.fault(episode.index, size):
                broken[episode.index] = fault
            done(number)
        whole = tuple(one for one in self.episodes if one.index not in broken)
        left_out = (*self.left_out, *broken.values())
        if not whole:
            raise UserError(f"{self.path}: expected a whole episode, found none; {left_out[-1]}")
        return replace(self, episodes=whole, left_out=left_out)

    @property
    def held_out(self) -> tuple[int, ...]:
        """Indices of the episodes that training leaves for validation."""
        return held_out([one.index for one in self.episodes])

    @property
    def training(self) -> tuple[int, ...]:
        """Indices of the others."""
        held = set(self.held_out)
        return tuple(one.index for one in self.episodes if one.index not in held)

    def scalings(self) -> tuple[Scaling, Scaling]:
        """The scaling of states and of actions, from the episodes for training."""
        numbers = [self.numbers(index) for index in self.training]
        return scaling_of(one for one, _ in numbers), scaling_of(one for _, one in numbers)

    def action_spread(self) -> Array:
        """(A,) standard deviation of each number of the actions, raw units, over the episodes for
        training; 1 where it is 0."""
        return spread_of([self.numbers(index)[1] for index in self.training])

    def _location(self, episode: int) -> Location:
        if episode not in self._locations:
            known = f"{len(self.episodes)} whole ones"
            raise UserError(f"{self.path}: expected one of its {known}, found episode {episode}")
        return self._locations[episode]

    def _pictures(self, location: Location) -> Iterator[tuple[int, int, Array]]:
        for number, camera in enumerate(self.cameras):
            if camera.key in location.films:
                film, start = location.films[camera.key]
                pictures = film_pictures(film, camera, self.fps, start, location.steps)
            else:
                pictures = table_pictures(location.data, camera, location.first, location.steps)
            for step, picture in pictures:
                yield step, number, picture


@lru_cache(maxsize=10_000)
def _digest(recordings: Recordings, episode: int) -> str:
    states, actions = recordings.numbers(episode)
    return hashlib.sha256(states.tobytes() + actions.tobytes()).hexdigest()[:16]


def open_recordings(path: Path | str) -> Recordings:
    """Raises UserError, one line, for a folder that is no LeRobotDataset of version 3 or of which
    no episode is whole."""
    path = Path(path)
    description = read_description(path)
    episodes, locations, broken = find_episodes(description)
    if not episodes:
        found = broken[0] if broken else "no episode"
        raise UserError(f"{path}: expected at least one whole episode, found none: {found}")
    return Recordings(
        path,
        path.resolve().name,
        description.fps,
        description.cameras,
        description.state_names,
        description.action_names,
        episodes,
        (*description.unread, *broken),
        description,
        locations,
    )
