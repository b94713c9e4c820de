"""The steps of a tour, its words and its actions: commands that a visitor's click would send, too.

The tour of two minutes:

    1 the page ─► 2 drop a camera ─► 3 switch it on again ─► 4 black instead ─► 5 a single camera
               ─► 6 another policy ─► 7 back in time ─► 8 your turn

Steps that make no sense here (another policy where there is none, a single camera of one) are left
out, and the count says so. The comparison has four steps: what it is, the same episode twice, what
the bars say, your turn. Where guards are fitted it has three acts on one seed instead: all cameras,
one that goes black, and the same with the guard.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from madviz.app.panels.policy import PolicyChoice
from madviz.guard.policy import SUFFIX
from madviz.observation.ablation import CameraInput, CameraState, Occlusion, OcclusionKind
from madviz.observation.displacement import MoveCamera
from madviz.observation.schedule import Event
from madviz.policies.guarded import unguarded, with_guard
from madviz.policies.seeds import FIRST_DEVELOPMENT
from madviz.session.commands import (
    Command,
    Compare,
    Link,
    Pause,
    Play,
    Reset,
    SetCamera,
    SetPolicy,
    SetSchedule,
    SetSeed,
    SetSpeed,
)
from madviz.session.ending import BOTH, NEITHER
from madviz.session.frame import Frame, untouched

Commands = tuple[Command, ...]
BACK = 10
"""Steps that the tour goes back in time."""
GOES_AT = 15
"""The step at which the comparison drops a camera: a second and a half after the start."""


class Step(NamedTuple):
    """A step: its words, and what is done meanwhile."""

    title: str
    words: str
    commands: Commands = ()
    back: int = 0
    """How many steps to look back."""
    go: str = "next step"
    """The label of the button that leads on."""
    leave: str = "end the tour"
    keep: bool = False
    """Whether leading on from the last step leaves things as they are."""
    guesses: tuple[str, ...] = ()
    """Answers to a question in the words; each leads on, too."""


def steps(frame: Frame, choices: Sequence[PolicyChoice]) -> Iterator[Step]:
    """The tour of what ``frame`` shows, beginning with all cameras and the policy that acts now."""
    unbroken = whole(frame)
    label = [camera.label for camera in frame.world.env.cameras]
    middle = len(label) // 2
    yield Step(
        "What you see",
        f"A robot works at a task; it is done when: {frame.world.env.success}. The pictures on the "
        "left are all that the robot's policy gets. Nothing here is a recording: it decides anew "
        "at every step, now, on this machine.",
        (*unbroken, SetSpeed(10.0), Reset(), Play()),
    )
    yield Step(
        "A camera is dropped",
        f"We have just dropped {label[middle]}: its picture is dim. The line under the pictures "
        "says by how much the robot's next movement has changed. Does it still do its task?",
        (_camera(frame, middle, "off"),),
    )
    yield Step(
        "The camera is back",
        f"{label[middle]} is back, and the movement is as it was. The robot did not have to start "
        "again: the features of all cameras are added up anew at every step.",
        (_camera(frame, middle),),
    )
    yield Step(
        "Black is not dropped",
        f"{label[-1]} sends a black picture now. That is worse than no picture: the feature of a "
        "black picture is added to the others. A camera that breaks is better dropped.",
        (_camera(frame, -1, kind="black"),),
    )
    if len(label) > 1:
        yield Step(
            f"Only {label[0]}",
            "Now one camera is left, the others are dropped. 'What if?' shows what it would do, at "
            "this very time step, with every other choice of cameras.",
            (
                _camera(frame, 0),
                *(_camera(frame, index, "off") for index in range(1, len(label))),
            ),
        )
    other = never_alone(frame.world.policy.name, choices)
    if other is not None:
        yield Step(
            "Another policy",
            "The same camera, but another policy: this one learned with all cameras and never with "
            "a single one. Watch the success under the pictures, and how the hand moves.",
            (SetPolicy(other), Reset(), Play()),
        )
    yield Step(
        "Back in time",
        "It has stopped, and the page shows what was a few steps ago, as it was then. The tab "
        "'Go back' has a slider for that: go back, drop a camera there, and see another run.",
        back=BACK,
    )
    yield Step(
        "Your turn",
        "Press off under any picture, or the keys 1, 2, 3; space stops and goes on. Which camera "
        "can this robot do without, and when? The button help, keys has the rest.",
        (Play(), *unbroken),
    )


def comparison_steps(frame: Frame, other: str) -> list[Step]:
    """MAD, which acts in ``frame``, against the policy ``other``, trained on all cameras only."""
    unbroken = whole(frame)
    camera = frame.world.env.cameras[0]
    dropped = (Event(GOES_AT, camera.name, dropped=True),)
    return [
        Step(
            "Can a robot lose a camera?",
            "Two policies for one task, in the same episode. MAD was trained on all cameras and on "
            "each one alone, Merged Only on all of them together and nothing else. At step "
            f"{GOES_AT}, {camera.label} is dropped on both sides. Which will still do it?",
            go="just show me",
            leave="explore one policy",
            guesses=("MAD", "Merged Only", BOTH, NEITHER),
        ),
        Step(
            "The same episode, twice",
            f"A is MAD, B is Merged Only. Both start from the same scene. At step {GOES_AT} "
            f"{camera.label} is dropped on both sides: its pictures turn dim. It is done when: "
            f"{frame.world.env.success}. The line under the pictures says how it ended.",
            (
                *unbroken,
                SetSpeed(10.0),
                Compare(other),
                Link(True),
                SetSchedule(dropped),
                Reset(),
                Play(),
            ),
            leave="explore one policy",
        ),
        Step(
            "What the bars say",
            "One episode says little. The bars on the right count many: A and B, for every choice "
            f"of cameras. Look at the row without {camera.label}, marked ▸ while it is dropped.",
            leave="explore one policy",
        ),
        Step(
            "Your turn",
            "Nothing fails by itself now. Press off or break under any picture: the switches "
            "act on A and B, until you choose 'A only'. Which cameras does each policy need?",
            (SetSchedule(()), *unbroken, Reset(), Play()),
            go="keep comparing",
            leave="explore one policy",
            keep=True,
        ),
    ]


def acts(frame: Frame, other: str) -> list[Step]:
    """``comparison_steps`` in three acts, for two policies with fitted guards."""
    camera = frame.world.env.cameras[0]
    first = unguarded(frame.world.reference)
    black = SetSchedule((Event(GOES_AT, camera.name, occlusion=Occlusion("black")),))
    intact = (SetPolicy(first), *whole(frame)[1:])
    again = (SetSeed(FIRST_DEVELOPMENT), Play())
    return [
        Step(
            "Can a robot lose a camera?",
            "Two policies for one task, three times from the same start: with all cameras, with "
            "one that goes black, and the same with a guard, which leaves out a camera that fails. "
            "MAD was trained on all cameras and on each one alone, Merged Only on all together.",
            go="show me",
            leave="explore one policy",
        ),
        Step(
            "All cameras",
            "A is MAD, B is Merged Only. It is done when: "
            f"{frame.world.env.success}. Next, at step {GOES_AT}, {camera.label} goes black on "
            "both sides, and stays in the sum. Which will still do it?",
            (*intact, SetSpeed(10.0), Compare(other), Link(True), SetSchedule(()), *again),
            go="just show me",
            leave="explore one policy",
            guesses=("MAD", "Merged Only", BOTH, NEITHER),
        ),
        Step(
            f"{camera.label} goes black",
            f"At step {GOES_AT} {camera.label} sends black on both sides. Black is not dropped: "
            "the black picture is added to the others, and nobody tells the policies that it is "
            "broken. The line under the pictures says how it ended.",
            (black, *again),
            leave="explore one policy",
        ),
        Step(
            "The same with the guard",
            "The guard watches the pictures. It notices the black one and leaves the camera out, "
            "so that it is as good as switched off. MAD was trained for that, Merged Only was not.",
            (
                Compare(with_guard(other, True)),
                Link(True),
                SetPolicy(with_guard(first, True)),
                black,
                *again,
            ),
            leave="explore one policy",
        ),
        Step(
            "Your turn",
            "Nothing fails by itself now. Press off or black under any picture, with the switch "
            "Guard or without it. One episode says little: the bars on the right count many.",
            (SetSchedule(()), *intact, Compare(other), Link(True), *again),
            go="keep comparing",
            leave="explore one policy",
            keep=True,
        ),
    ]


def whole(frame: Frame) -> Commands:
    """Commands for all cameras as nobody has touched them, and the policy of ``frame``."""
    cameras = (_camera(frame, index) for index in range(len(frame.world.env.cameras)))
    back = (MoveCamera(name, None) for name in frame.world.ablation.moves)
    return (SetPolicy(frame.world.reference), *cameras, *back)


def never_alone(policy: str, choices: Sequence[PolicyChoice]) -> str | None:
    """The name of the policy like this one that learned with all cameras only, if it is offered."""
    name = policy.removesuffix(SUFFIX)
    wanted = name.replace("-mad-", "-merged-only-")
    names = [choice.name for choice in choices]
    return wanted if wanted != name and wanted in names else None


def _camera(
    frame: Frame, index: int, switch: CameraInput | None = None, kind: OcclusionKind = "none"
) -> SetCamera:
    state = CameraState(switch or untouched(frame.world.policy).input, Occlusion(kind))
    return SetCamera(frame.world.env.cameras[index].name, state)


def compares(step: Step) -> bool:
    """Whether a step begins a comparison."""
    return any(isinstance(command, Compare) for command in step.commands)


def restored(frame: Frame, compared: bool = False) -> Commands:
    """Commands for cameras, policy, speed and pause as in ``frame``; if something was ``compared``,
    also for the failures that come by themselves, and for B."""
    world = frame.world
    cameras = (SetCamera(c.name, frame.camera(c.name)) for c in world.env.cameras)
    moves = (MoveCamera(c.name, world.ablation.moves.get(c.name)) for c in world.env.cameras)
    alone = (Compare(None), SetSchedule(frame.schedule)) if compared else ()
    b = frame.second.world if compared and frame.second is not None else None
    beside = (Compare(b.reference, b.ablation), Link(frame.linked)) if b is not None else ()
    paused = (Pause(),) if frame.pace.phase == "paused" else ()
    policy = SetPolicy(world.reference)
    speed = SetSpeed(frame.pace.speed)
    return (*alone, policy, *cameras, *moves, *beside, speed, *paused)
