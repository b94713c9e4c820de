"""``madviz record --vs``: two policies on the same episodes, in one film."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from madviz import cli
from madviz.envs.registry import env_spec, make_env
from madviz.measure.statistics import SuccessRate
from madviz.observation.condition import Condition
from madviz.observation.schedule import parse_schedule
from madviz.recording import film, record, scene_view
from madviz.recording.film import chapters
from madviz.recording.film_files import SmallFilm
from madviz.recording.frames import frames
from madviz.recording.scene_view import KeepsActions, SceneView
from madviz.session.session import Session
from tests.fakes import FakePolicy, policies
from tests.mistakes import refused

HORIZON = 25


@pytest.fixture(autouse=True)
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record.checkpoint, "load_policy", policies)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes of a toy, drawn in little time."""
    monkeypatch.setattr(scene_view.SceneView, "picture", _grey)
    monkeypatch.setattr(film, "known_rates", lambda references: lambda *side: SuccessRate.of(9, 10))


def _grey(scene: SceneView, actions: list[np.ndarray]) -> np.ndarray:
    return np.full((scene._height, scene._width, 3), len(actions), np.uint8)


def test_a_film_has_a_chapter_for_each_seed(
    tmp_path: Path, small: None, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x.mp4"
    words = ["--policy", "toy-mad", "--vs", "toy-other", "--drop", "third_a@5", "--fps", "2"]
    assert cli.main(["record", *words, "--seed", "3", "--episodes", "2", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "Third A is dropped from step 5, seed 3: Third A was dropped at step 5." in said
    assert [each.name for each in tmp_path.iterdir()] == ["x.mp4"]
    lasts = round(1000 * (film.HOLD_FIRST + (HORIZON - 1) / 2 + film.HOLD_LAST))
    with av.open(str(out)) as found:
        first, second = found.chapters()
        shown = found.streams.video[0]
        assert (shown.width, shown.height, shown.average_rate) == (1920, 1080, 2)
    assert (first["end"], second["start"], second["end"]) == (lasts, lasts, 2 * lasts)
    assert second["metadata"]["title"] == "Third A is dropped from step 5, seed 4"


def test_acts_are_intact_failing_and_guarded() -> None:
    env = env_spec("toy/reach")
    schedule = parse_schedule(["first=black@2"], [camera.name for camera in env.cameras])
    acts = chapters(env, range(7, 8), schedule, acts=True, guard=False)
    assert [(act.title, bool(act.schedule), act.guard) for act in acts] == [
        ("1 of 3: all cameras", False, False),
        ("2 of 3: First person sends black from step 2", True, False),
        ("3 of 3: First person sends black from step 2, with the guard", True, True),
    ]


def test_the_scene_is_that_of_the_same_step() -> None:
    made: list[KeepsActions] = []

    def watched(*world: object) -> KeepsActions:
        made.append(KeepsActions(make_env(*world)))  # type: ignore[arg-type]
        return made[-1]

    session = Session(watched, policies("toy-mad"), policies, seed=5, speed=None)  # type: ignore[arg-type]
    episode = list(frames(session, None))
    scene = SceneView(episode[0], 60, 40)
    scene.begin(5)
    assert scene.picture(made[0].actions[:9]).shape == (40, 60, 3)
    assert np.array_equal(scene._env.hand(), episode[9].world.hand)
    scene.begin(5)
    scene.picture(made[0].actions)
    assert np.array_equal(scene._env.hand(), episode[HORIZON].world.hand)


class NothingPlayed:
    """A table without an episode."""

    def __init__(self, *_: object) -> None: ...

    def outcomes(self, condition: Condition) -> dict[int, bool]:
        return {}


def test_policies_of_one_name_have_their_own_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (replace(FakePolicy().spec, digest=digest) for digest in ("a", "b"))
    rates = {
        folder: {"all": {"success": rate, "n": 50}}
        for folder, rate in (("runs/a", 1.0), ("runs/b", 0.2))
    }
    monkeypatch.setattr(film.checkpoint, "is_folder", lambda reference: bool(reference))
    monkeypatch.setattr(film, "Table", NothingPlayed)
    monkeypatch.setattr(
        film.checkpoint, "shipped_evaluation", lambda folder: {"subsets": rates[folder]}
    )
    known = film.known_rates({film.known_as(first): "runs/a", film.known_as(second): "runs/b"})
    assert [known(spec, Condition("all")).value for spec in (first, second)] == [1.0, 0.2]


def test_a_scene_of_a_task_with_small_views_is_drawn_larger(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = Session(make_env, policies("toy-mad"), policies, seed=5, speed=None)
    (frame, *_) = frames(session, None)
    monkeypatch.setattr(scene_view, "largest_view", lambda profile: 30)
    scene = SceneView(frame, 60, 40)
    scene.begin(5)
    assert scene.picture([]).shape == (40, 60, 3)


def test_a_small_film_leaves_pictures_out_and_keeps_its_length(tmp_path: Path) -> None:
    small = SmallFilm(tmp_path / "x.webp")
    for number in range(8):
        picture = np.full((108, 192, 3), 30 * number, np.uint8)
        small.add(picture, 2.0 if number in (0, 7) else 0.1)
    small.close([])
    with Image.open(tmp_path / "x.webp") as read:
        assert read.n_frames == 4  # type: ignore[attr-defined]
    assert small.seconds == pytest.approx(4.6)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--acts",), "expected failures for the second act, found none"),
        (("--out", "x.rrd"), "expected a name that ends in .mp4 or .webp, found .rrd"),
        (("--steps", "3"), "expected whole episodes with --vs"),
        (("--vs", "wurst"), "unknown policy 'wurst'"),
        (("--video",), "expected --vs without --video and --noise"),
    ],
)
def test_a_mistake_is_one_line(
    words: tuple[str, ...],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    standard = {"--policy": "toy-mad", "--vs": "toy-other", "--out": "x.mp4"}
    given = [f for pair in standard.items() if pair[0] not in words for f in pair]
    refused(["record", *given, *words], said, capsys)
    assert not list(tmp_path.iterdir())
