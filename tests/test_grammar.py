"""What happens to a camera, in words: one grammar for evaluations, recordings and the page."""

from __future__ import annotations

import pytest

from madviz.errors import UserError
from madviz.observation.ablation import Occlusion
from madviz.observation.grammar import (
    CameraFailure,
    failure_text,
    parse_failure,
    parse_occlusions,
)
from madviz.observation.schedule import Event, parse_schedule

NOISE = Occlusion("noise", 0.5)


def test_each_form_is_one_failure() -> None:
    assert parse_failure("third_a") == CameraFailure("third_a", None)
    assert parse_failure("third_a=off@20") == CameraFailure("third_a", None, 20)
    assert parse_failure("first=noise:0.5") == CameraFailure("first", NOISE)
    assert parse_failure("first=noise:0.5@10-18") == CameraFailure("first", NOISE, 10, 18)


def test_without_steps_a_failure_lasts_for_the_whole_episode() -> None:
    assert parse_schedule(["third_a", "first=black"], ("first", "third_a")) == (
        Event(0, "third_a", dropped=True),
        Event(0, "first", occlusion=Occlusion("black")),
    )


def test_an_evaluation_reads_occlusions_of_whole_episodes() -> None:
    strip = "third_b=patch:1:0.5:0.9:1:0.2"
    assert parse_occlusions(["first=black", "third_a=noise:0.5", strip]) == {
        "first": Occlusion("black"),
        "third_a": NOISE,
        "third_b": Occlusion("patch", y=0.9, width=1.0, height=0.2),
    }


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("first", "a dropped camera; leave it out of --subsets"),
        ("first=noise:0.5@10-18", "leave out what follows the @"),
        ("first=fog", "unknown failure 'fog'"),
        ("first=noise:2", "expected a number from 0 to 1"),
        ("first=noise,strength=2", "between 0 and 1"),
        ("first=noise,strong", "expected a failure such as"),
        ("a=noise,b=1", "expected a failure such as"),
        ("first=patch,size=0.3,width=0.2", "a size or a width and a height"),
    ],
)
def test_an_evaluation_refuses_what_it_cannot_do_in_one_line(word: str, says: str) -> None:
    with pytest.raises(UserError, match=says) as refused:
        parse_occlusions([word])
    assert "\n" not in str(refused.value)


def test_the_older_spelling_is_read_and_the_new_one_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    old = ["third_a=noise,strength=0.5,size=0.1", "third_b=patch,y=0.9,width=1,height=0.2"]
    assert parse_occlusions(old) == {
        "third_a": Occlusion("noise", strength=0.5, width=0.1, height=0.1),
        "third_b": Occlusion("patch", y=0.9, width=1.0, height=0.2),
    }
    first, second = capsys.readouterr().err.splitlines()
    assert first == f"note: {old[0]!r} is an older spelling, write 'third_a=noise:0.5'"
    assert second.endswith("write 'third_b=patch:1:0.5:0.9:1:0.2'")
    (same,) = parse_occlusions([second.split("'")[-2]]).values()
    assert same == Occlusion("patch", y=0.9, width=1.0, height=0.2)


@pytest.mark.parametrize("word", ["third_a", "first=black", "first=patch:0.5", "third_a@20"])
def test_a_failure_can_be_written_again(word: str) -> None:
    failure = parse_failure(word)
    begin = failure.begin if "@" in word else None
    assert failure_text(failure.camera, failure.occlusion, begin) == word


def test_what_a_kind_does_not_use_is_not_written() -> None:
    assert failure_text("first", Occlusion("black", strength=0.5)) == "first=black"
