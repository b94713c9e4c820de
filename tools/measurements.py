"""Tables of what programs measured, as Markdown, from the files in results/: benchmarks, the class
server, imagined cameras, the site. ``fill_figures.py`` writes them into the docs.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from policy_files import LABELS, ROOT, SINGLES, on_development, policies, rates, row

from madviz.measure.statistics import SuccessRate, pair
from madviz.report.layouts import THREE
from madviz.system.markdown import markdown_table

CLASS_RUNS = ("lessons", "pages", "alone")
"""Files of ``python -m tests.e2e.class_server`` in results/archive/class."""
MEASURED = ("kernel", "all")
"""Two parts of a lesson's memory: its kernel, and all that the student runs."""
ABLATION = "imagine/ablation/toy"
BESIDE_IMAGINING = (
    "metaworld-hammer-mv-mae-light",
    "metaworld-hammer-mad-light-12x300",
    "metaworld-hammer-single-first-light-12x300",
    "metaworld-hammer-single-third_a-light-12x300",
    "metaworld-hammer-single-third_b-light-12x300",
    "maniskill-push-cube-mv-mae-light",
    "maniskill-push-cube-mad-light-12x300",
    "maniskill-push-cube-single-first-light",
    "maniskill-push-cube-single-third_a-light",
    "maniskill-push-cube-single-third_b-light",
    "maniskill-push-cube-mv-mwm-mv-mwm",
    "maniskill-push-cube-mad-paper-vectorised",
    "maniskill-push-cube-single-third_a-paper-vectorised",
    "toy-reach-mv-mwm-mv-mwm",
    "toy-reach-mad-paper-vectorised",
    "toy-reach-single-first-paper-vectorised",
    "toy-reach-single-third_a-paper-vectorised",
    "toy-reach-single-third_b-paper-vectorised",
)
"""Folders of policies that imagine, each before those it is compared with."""
FASTER = "{ours_ms:.0f} ms; stock {stock_ms:.0f} ms; {ratio:.1f} times faster"
PAGE = (
    "{updates_per_s:.0f} updates per second; a switch is seen after {toggle_ms_p50:.0f} ms, 19 of "
    "20 times within {toggle_ms_p95:.0f} ms"
)
BENCHMARKS = (
    ("render", "", "render", FASTER),
    ("render-maniskill", "", "render --suite maniskill", FASTER),
    ("live", "", "live", f"one page: {PAGE}"),
    ("live", "with_workers", "live", f"beside an evaluation: {PAGE}"),
    ("live-training", "with_training", "live --training", f"beside a training: {PAGE}"),
    (
        "live-imagined",
        "",
        "live --policy toy-reach-mv-mwm-mv-mwm --workers 0",
        "while a dropped camera is imagined: {updates_per_s_dropped:.0f} updates per second (with "
        "all cameras {updates_per_s:.0f})",
    ),
    (
        "crowd",
        "",
        "crowd",
        "{visitors} visitors at once: {decisions_per_s} decisions per second each, of {speed:.0f} "
        "asked for; {cores} cores, {mb} MB",
    ),
    (
        "update",
        "",
        "update",
        "{ours_ms:.0f} ms; simple {naive_ms:.0f} ms; {ratio:.1f} times faster ({precision})",
    ),
    (
        "update-cuda",
        "",
        "update --device cuda",
        "on one {device}: {ours_ms:.1f} ms; simple {naive_ms:.1f} ms; {ratio:.1f} times faster "
        "({precision})",
    ),
    (
        "buffer",
        "",
        "buffer",
        "{times_smaller:.1f} times smaller; a batch takes {times_slower_to_sample:.1f} times as "
        "long",
    ),
    (
        "evaluate",
        "",
        "evaluate --workers 2",
        "{ours:.1f} episodes per minute; one process {serial:.1f} ({ratio_serial:.1f} times), with "
        "the simulator's own rendering {stock:.2f} ({ratio_stock:.0f} times)",
    ),
    (
        "recordings",
        "",
        "recordings --lerobot PYTHON",
        "{episodes} episodes of three cameras, {height} x {width}: {frames_per_s:.0f} pictures "
        "read in a second, {times_lerobot:.1f} times as many as by LeRobot's loader; a round of "
        "training {round_s:.0f} s; {memory_mb:,.0f} MB",
    ),
)
"""A file of results/archive/bench, the part that is meant, its command, a sentence about it."""


def read(name: str) -> dict[str, Any]:
    """A file of results/, by its path without the ending."""
    return json.loads((ROOT / "results" / f"{name}.json").read_text())


def read_all(pattern: str) -> dict[str, dict[str, Any]]:
    """Files of results/, by their names without the ending."""
    files = sorted((ROOT / "results").glob(f"{pattern}.json"))
    return {file.stem: json.loads(file.read_text()) for file in files}


def table(header: Sequence[str], rows: Iterable[Sequence[object]], machine: str = "") -> str:
    """A block: a table of ``rows``, and where it was measured."""
    text = markdown_table(header, [[str(cell) for cell in row] for row in rows])
    return f"{text}\n\nOn {machine}.\n" if machine else f"{text}\n"


def benchmarks() -> str:
    """Results of benchmarks, from results/archive/bench: a row for each of ``BENCHMARKS``."""
    rows = []
    for name, part, command, sentence in BENCHMARKS:
        result = read(f"archive/bench/{name}")
        measured = sentence.format(**(result[part] if part else result))
        rows.append((f"`python -m benchmarks {command}`", re.sub(r"[][]", "", measured)))
    return table(("benchmark", "measured"), rows, read("archive/bench/machine")["machine"])


WAITS = {
    "metaworld": "hammer: ",
    "maniskill": "push-cube: ",
    "commands": "",
}
"""A suite of `benchmarks waits`, and how its sentences begin."""
SENTENCES = {
    "first_picture_s": "from the command to the first picture",
    "task_switch_s": "another task",
    "one_more_s": "one visitor more, until the picture",
    "one_more_mb": "one visitor more, memory",
    "cell_s": "a lesson's first cell",
    "help_s": "`madviz --help`",
    "list_s": "`madviz list`",
    "eval_s": "`madviz eval`, one episode",
    "train_s": "`madviz train`, one episode and one update",
}
"""A number of `benchmarks waits`, and its sentence."""
WITHOUT_IMPORTS = ("task_switch_s", "one_more_s", "one_more_mb", "help_s", "list_s")


def waits() -> str:
    """Results of `benchmarks waits`, for each suite: now, before, and plain imports."""
    rows = []
    for suite, begin in WAITS.items():
        result = read(f"archive/bench/waits-{suite}")
        now, before = result["now"], result["before"]
        for key, sentence in SENTENCES.items():
            if key in now:
                floor = "" if key in WITHOUT_IMPORTS else f"{now['floor_s']:.1f} s"
                ours, theirs = (
                    f"{one[key]:.0f} MB" if key == "one_more_mb" else f"{one[key]:.1f} s"
                    for one in (now, before)
                )
                exact = before[key] >= 0.1  # The files have hundredths of a second.
                ratio = f"{now[key] / before[key]:.2f}" if exact else "–"
                rows.append((begin + sentence, floor, ours, theirs, ratio))
    return table(("wait", "imports alone", "now", "before", "ratio"), rows)


def priorities() -> str:
    """The page beside other work, before that had a lower priority and now, in alternation."""
    result = read("archive/bench/priorities")
    parts = ("alone", "with_workers", "with_training")
    rows = [
        (
            run["side"],
            *("{updates_per_s:.1f}; {toggle_ms_p95:.0f} ms".format(**run[p]) for p in parts),
        )
        for run in result["runs"]
    ]
    header = ("run", "alone", "beside an evaluation", "beside a training")
    return table(header, rows, result["machine"])


def class_server() -> str:
    """The times and the memory of students on a class server, from results/archive/class, and the
    machine that more students need."""
    lessons, pages, alone = (read(f"archive/class/{run}") for run in CLASS_RUNS)
    students = list(lessons["each"].values())
    cores = lessons["cores"]
    logins = [student["login_s"] for student in students]
    numbers = sorted({name[:2] for student in students for name in student if name[:2].isdigit()})
    slowest = [_slowest(students, number) for number in numbers]
    single = [size for student in alone["each"].values() for size in student["memory_mb"].items()]
    largest = max(size for name, size in single if name.endswith(" all"))
    whole = max(largest, *(row[-1] for row in slowest))
    machines = [
        (count, -(-count * cores // len(students)), f"{math.ceil(2 + count * whole / 1024)} GB")
        for count in (4, 10, 20, 30)
    ]
    shown = [student["page"] for student in pages["each"].values()]
    more = max(student["memory_mb"]["page page"] for student in pages["each"].values())
    timed = [
        times
        for student in alone["each"].values()
        for name, times in student.items()
        if name[:2].isdigit()
    ]
    opened = [times["opened_s"] for times in timed]
    kernels = [times["kernel_s"] for times in timed]
    times_header = ("lesson", "open (s)", "new kernel (s)", "all cells (s)")
    memory_header = ("kernel (MB)", "whole student (MB)")
    return "\n".join(
        [
            f"Measured with {lessons['students']} students at once on {cores} cores, their "
            "browsers on the same cores, torch with its CUDA libraries. A login took "
            f"{min(logins):.0f} to {max(logins):.0f} s. Of each lesson the slowest, and the "
            "largest memory:\n",
            table((*times_header, *memory_header), slowest),
            "Memory is proportional: what several processes share counts once. The largest lesson "
            f"took {largest} MB, measured with one student. Computed from these, with as many "
            "students for each core, one kernel each, and 2 GB for the system:\n",
            table(("students", "cores", "memory"), machines),
            f"With {len(shown)} live pages at once, whose browsers hardly drew the 3D scene, each "
            f"had its first numbers after {max(page['shown_s'] for page in shown):.0f} s at most, "
            f"then at least {min(page['messages_a_second'] for page in shown):.0f} messages a "
            f"second, and took {more} MB more at most. Lesson 9 opens one for each student: add "
            "that.\n",
            f"With one student on the machine ({len(timed)} lessons), a lesson was open after "
            f"{min(opened):.0f} to {max(opened):.0f} s, and a new kernel answered after "
            f"{max(kernels):.1f} s at most.\n",
        ]
    )


def _slowest(students: Sequence[dict[str, Any]], number: str) -> list[Any]:
    """The longest times and the largest memory of any student in one lesson."""
    timed = [student[name] for student in students for name in student if name[:2] == number]
    times = [max(run[key] for run in timed) for key in ("opened_s", "kernel_s", "cells_s")]
    memory = [max(s["memory_mb"][f"{number} {part}"] for s in students) for part in MEASURED]
    return [int(number), *(f"{seconds:.0f}" for seconds in times), *memory]


def grading() -> str:
    """How long a class's copies took to grade, from results/archive/class/grading.json."""
    result = read("archive/class/grading")
    return (
        f"{result['copies']} copies of lesson {int(result['lesson'][:2])} took "
        f"{result['seconds'] / 60:.0f} minutes with {result['workers']} workers on two cores: "
        f"{result['right']} right ones, and empty, wrong, edited, crashing and endless ones, "
        "ones that want too much memory, and one that is no notebook.\n"
    )


def kernel_memory() -> str:
    """Where the memory of a lesson's kernel goes, from results/archive/class/kernel.json."""
    result = read("archive/class/kernel")
    rows = [(step["after"], step["pss_mb"], step["own_mb"]) for step in result["steps"]]
    measured = table(("after", "MB (proportional)", "of them, nobody can share"), rows)
    return f"{measured}\ntorch {result['torch']}, one kernel alone.\n"


def imagine() -> str:
    """Results of `benchmarks imagine`, from results/imagine: one row for each camera that is hidden
    while all others are seen."""
    header = ("task", "network", "hidden", "imagined", "worst frame", "mean", "another episode")
    errors = ("imagined", "worst", "mean_picture", "other_episode", "gain")
    rows = [
        (
            result["task"],
            result.get("policy") or "trained for this",
            LABELS[hidden["hidden"]],
            *(f"{hidden[error]:.1f}" for error in errors),
            "yes" if hidden["gain"] >= 3 else "no",
        )
        for result in read_all("imagine/*").values()
        for hidden in _one_hidden(result)
    ]
    return table((*header, "gain", "passes"), rows)


def view_masking() -> str:
    """Gains of a network with whole views hidden in training and of one without, by camera."""
    masked, without = (
        {row["hidden"]: f"{row['gain']:.1f}" for row in _one_hidden(read(f"{ABLATION}-{name}"))}
        for name in ("view-masking", "no-view-masking")
    )
    rows = [(LABELS[camera], gain, without[camera]) for camera, gain in masked.items()]
    return table(("hidden", "with view masking", "without"), rows)


def _one_hidden(result: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of a result of `benchmarks imagine` in which all other cameras are seen."""
    most = max(row["from"].count("+") for row in result["rows"])
    return [row for row in result["rows"] if row["from"].count("+") == most]


def beside_imagining() -> str:
    """Policies that imagine, and MAD and Single Camera on the same task after as many episodes or
    decisions: one row each, on development seeds. Raises KeyError if one is missing."""
    rows = []
    for folder in BESIDE_IMAGINING:
        config = policies()[folder].config
        training = config.training
        experience = (
            f"{training.labelled_episodes} episodes"
            if training.steps is None
            else f"{training.steps:,} decisions"
        )
        trained = f"{experience}, {training.updates:,} updates of {training.batch_size}"
        minutes = round((training.wall_time_s or 0) / 60)
        success = rates(on_development(folder), THREE)
        rows.append((config.task, config.method, trained, minutes, *success))
    return table(("task", "method", "trained for", "minutes", "all", *LABELS.values()), rows)


def site_speed() -> str:
    """The size of a site's downloads, and how fast it acts, from results/site/speed.json."""
    result = read("site/speed")
    rows = [
        (backend, f"{speed['one']:.1f}", f"{speed['side_by_side']:.1f}")
        for backend, speed in result["decisions_per_s"].items()
    ]
    header = ("OpenGL is computed by", "one policy", "two side by side, each")
    return (
        f"{result['one_policy_mb']:.1f} MB until one policy acts, {result['first_load_mb']:.1f} MB "
        f"until two do. Decisions per second:\n\n{table(header, rows, result['machine'])}"
    )


def places() -> str:
    """Results of `benchmarks places` for policies with a weak camera, from results/places, beside
    the success of each camera alone."""
    rows = []
    for result in read_all("places/*").values():
        alone = row(result["policy"])
        for place in sorted(result["rows"], key=lambda place: SINGLES.index(place["stream"])):
            camera = place["stream"]
            errors = (f"{place[source + '_cm']:.1f} cm" for source in ("feature", "state", "mean"))
            picture = (place["place"], f"{place['in_picture']:.2f}")
            success = rates(alone, [camera])
            rows.append((result["policy"], LABELS[camera], *success, *picture, *errors))
    header = ("policy", "camera", "success alone", "place", "in its picture", "from its feature")
    return table((*header, "from the state", "mean place"), rows)


def soak() -> str:
    """Memory and threads of the page's server before and after each run of `benchmarks soak`."""
    rows = []
    for result in read_all("archive/soak/*").values():
        memory = result["memory_mb"]
        threads = result["threads"]
        rows.append(
            (
                result["policy"],
                result["workers"],
                f"{result['minutes']:.0f}",
                f"{result['visits']:,}",
                f"{result['touches']:,}",
                f"{memory['after_warm_up']:.0f}, {memory['end']:.0f}",
                f"{memory['growth_an_hour']:+.1f} MB",
                f"{threads['after_warm_up']}, {threads['end']}",
                result["log_lines"],
            )
        )
    visits = ("policy", "workers", "minutes", "visits", "controls used")
    memory_header = "memory after warm-up, at the end (MB)"
    return table((*visits, memory_header, "an hour", "threads", "lines in the log"), rows)


def site_success() -> str:
    """Success that `benchmarks site` counted in a browser, from results/site, beside Python's on
    the same seeds: one row for each policy and subset that was tried."""
    rows = []
    for result in read_all("site/success-*").values():
        played: dict[tuple[str, str], dict[int, bool]] = {}
        for episode in result["episodes"]:
            outcomes = played.setdefault((episode["policy"], episode["subset"]), {})
            outcomes[episode["seed"]] = episode["success"]
        for (name, subset), browser in played.items():
            policy = policies()[name]
            measured = {**policy.outcomes.get(subset, {}), **policy.development.get(subset, {})}
            python = {seed: measured[seed] for seed in browser}
            success = (SuccessRate.counted(outcomes.values()) for outcomes in (browser, python))
            paired = pair(browser, python)
            only = f"{paired.first_only}, {paired.second_only}"
            label = LABELS.get(subset, subset)
            rows.append((name, label, *success, only, f"{paired.mcnemar():.2g}"))
    header = ("policy", "cameras", "in the browser", "in Python", "only browser, only Python", "p")
    return table(header, rows)


def wiring() -> str:
    """The faults of ``tests/wiring_faults.py``, with what the command said of each, and how often
    it advised a change where nothing was wrong."""
    rows: list[dict[str, Any]] = json.loads((ROOT / "results" / "wiring.json").read_text())
    faults = [row for row in rows if row["fault"] != "none"]
    clean = [row for row in rows if row["fault"] == "none"]
    count = Counter(row["judged"] for row in faults)
    wins, n = (sum(row["as_wired"][i] for row in clean) for i in (0, 1))
    advised = sum(row["verdict"] == "helps" for row in clean)
    header = ("fault", "result", "as wired", "best change")
    lines = [
        (row["fault"], row["judged"], " of ".join(map(str, row["as_wired"])), _with_change(row))
        for row in faults
    ]
    return (
        f"{table(header, lines)}\n{count['right']} of {len(faults)} faults were named, "
        f"{count['wrong']} wrongly; {count['cannot tell']} were undecided. In {len(clean)} runs "
        f"without a fault, on a policy that succeeded in {wins} of {n} episodes, {advised} changes "
        "were advised.\n"
    )


def _with_change(row: dict[str, Any]) -> str:
    """``pictures mirrored: 6 of 6``."""
    said = row["sentence"].partition(" With ")[2].partition(".")[0]
    label, _, rate = said.rpartition(": ")
    return f"{label[:60]}{'…' if len(label) > 60 else ''}: {rate}"
