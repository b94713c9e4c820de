"""Tables of what programs measured, as Markdown, from the files in results/: benchmarks, the class
server, imagined cameras, the site. ``fill_figures.py`` writes them into the docs.
"""

from __future__ import annotations

import json
import math
import re
from typing import Any

from policy_files import LABELS, ROOT, SINGLES, config_of, evaluation, rate

from madviz.measure.statistics import SuccessRate, pair
from madviz.soak.soak import growth_an_hour

CLASS_RUNS = ("lessons", "pages", "alone")
"""Of results/class: files of ``python -m tests.e2e.class_server``."""
MEASURED = ("kernel", "all")
"""What the memory of a lesson is given for: its kernel, and all that the student runs."""
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
)
"""A file of results/bench, the part of it that is meant, its command, a sentence about it."""


def benchmarks() -> str:
    """What benchmarks measured, from results/bench: a row for each of ``BENCHMARKS``."""
    folder = ROOT / "results" / "bench"
    lines = ["| benchmark | measured |", "|---|---|"]
    for name, part, command, words in BENCHMARKS:
        found = json.loads((folder / f"{name}.json").read_text())
        said = words.format(**(found[part] if part else found))
        lines.append(f"| `python -m benchmarks {command}` | {re.sub(r'[][]', '', said)} |")
    return "\n".join(lines) + f"\n\nOn {machine()}.\n"


def priorities() -> str:
    """The page beside other work, before that had a lower priority and now, in alternation."""
    found = json.loads((ROOT / "results" / "bench" / "priorities.json").read_text())
    lines = [
        "| run | alone | beside an evaluation | beside a training |",
        "|---|---|---|---|",
    ]
    for run in found["runs"]:
        cells = (
            f"{run[part]['updates_per_s']:.1f}; {run[part]['toggle_ms_p95']:.0f} ms"
            for part in ("alone", "with_workers", "with_training")
        )
        lines.append(f"| {run['side']} | {' | '.join(cells)} |")
    return "\n".join(lines) + f"\n\nOn {found['machine']}.\n"


def class_server() -> str:
    """What students took of a class server, from results/class, and what more would take."""
    folder = ROOT / "results" / "class"
    lessons, pages, alone = (json.loads((folder / f"{run}.json").read_text()) for run in CLASS_RUNS)
    students, cores = lessons["students"], lessons["cores"]
    each = list(lessons["each"].values())
    logins = [one["login_s"] for one in each]
    lines = [
        f"Measured with {students} students at once on {cores} cores, their browsers on the same "
        f"cores, torch with its CUDA libraries. A login took {min(logins):.0f} to "
        f"{max(logins):.0f} s. Of each lesson the slowest, and the largest memory:\n",
        "| lesson | open (s) | new kernel (s) | all cells (s) | kernel (MB) | whole student (MB) |",
        "|---|---|---|---|---|---|",
    ]
    whole = 0
    for number in sorted({name[:2] for one in each for name in one if name[:2].isdigit()}):
        timed = [one[name] for one in each for name in one if name[:2] == number]
        times = (max(one[key] for one in timed) for key in ("opened_s", "kernel_s", "cells_s"))
        memory = [max(one["memory_mb"][f"{number} {what}"] for one in each) for what in MEASURED]
        whole = max(whole, memory[-1])
        words = (f"{int(number)}", *(f"{took:.0f}" for took in times), *map(str, memory))
        lines.append(f"| {' | '.join(words)} |")
    lines += [
        "\nMemory is proportional: what several processes share counts once. So, with as many "
        "students for each core, one kernel each, and 2 GB for the system:\n",
        "| students | cores | memory |",
        "|---|---|---|",
    ]
    for number in (4, 10, 20, 30):
        needed = math.ceil(2 + number * whole / 1024)
        lines.append(f"| {number} | {-(-number * cores // students)} | {needed} GB |")
    shown = [one["page"] for one in pages["each"].values()]
    more = max(one["memory_mb"]["page page"] for one in pages["each"].values())
    lines.append(
        f"\nWith {len(shown)} live pages at once, whose browsers hardly drew the 3D scene, "
        "each had its first numbers after "
        f"{max(one['shown_s'] for one in shown):.0f} s at most, then at least "
        f"{min(one['messages_a_second'] for one in shown):.0f} messages a second, and took "
        f"{more} MB more at most."
    )
    timed = [
        one for found in alone["each"].values() for name, one in found.items() if name[:2].isdigit()
    ]
    opened, kernels = ([one[key] for one in timed] for key in ("opened_s", "kernel_s"))
    lines.append(
        f"\nWith one student on the machine ({len(timed)} lessons), a lesson was open after "
        f"{min(opened):.0f} to {max(opened):.0f} s, and a new kernel answered after "
        f"{max(kernels):.1f} s at most."
    )
    return "\n".join(lines) + "\n"


def grading() -> str:
    """How long a class's copies took to grade, from results/class/grading.json."""
    found = json.loads((ROOT / "results" / "class" / "grading.json").read_text())
    return (
        f"{found['copies']} copies of lesson {int(found['lesson'][:2])} took "
        f"{found['seconds'] / 60:.0f} minutes with {found['workers']} workers on two cores: "
        f"{found['right']} right ones, and empty, wrong, edited, crashing and endless ones, "
        "ones that want too much memory, and one that is no notebook.\n"
    )


def kernel_memory() -> str:
    """Where the memory of a lesson's kernel goes, from results/class/kernel.json."""
    found = json.loads((ROOT / "results" / "class" / "kernel.json").read_text())
    lines = ["| after | MB (proportional) | of them, nobody can share |", "|---|---|---|"]
    lines += [f"| {one['after']} | {one['pss_mb']} | {one['own_mb']} |" for one in found["steps"]]
    return "\n".join([*lines, f"\ntorch {found['torch']}, one kernel alone."]) + "\n"


def imagine() -> str:
    """What `benchmarks imagine` measured, from results/imagine: one row for each camera that is
    hidden while all others are seen."""
    lines = [
        "| task | network | hidden | imagined | worst frame | mean | another episode | gain | "
        "passes |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for file in sorted((ROOT / "results" / "imagine").glob("*.json")):
        found = json.loads(file.read_text())
        network = found.get("policy") or "trained for this"
        for row in _one_hidden(found):
            words = ("imagined", "worst", "mean_picture", "other_episode", "gain")
            numbers = " | ".join(f"{row[word]:.1f}" for word in words)
            passes = "yes" if row["gain"] >= 3 else "no"
            lines.append(
                f"| {found['task']} | {network} | {LABELS[row['hidden']]} | {numbers} | {passes} |"
            )
    return "\n".join(lines) + "\n"


def view_masking() -> str:
    """Gains of a network with whole views hidden in training and of one without, by camera."""
    gains = {}
    for name in ("view-masking", "no-view-masking"):
        file = ROOT / "results" / "imagine" / "ablation" / f"toy-{name}.json"
        rows = _one_hidden(json.loads(file.read_text()))
        gains[name] = {row["hidden"]: f"{row['gain']:.1f}" for row in rows}
    with_it, without = gains.values()
    lines = ["| hidden | with view masking | without |", "|---|---|---|"]
    lines += [f"| {LABELS[one]} | {gain} | {without[one]} |" for one, gain in with_it.items()]
    return "\n".join(lines) + "\n"


def _one_hidden(found: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of a result of `benchmarks imagine` in which all other cameras are seen."""
    most = max(row["from"].count("+") for row in found["rows"])
    return [row for row in found["rows"] if row["from"].count("+") == most]


def beside_imagining() -> str:
    """Policies that imagine, and MAD and Single Camera on the same task after as many episodes or
    decisions: one row each, on development seeds. Raises FileNotFoundError if one is missing."""
    columns = ("all", *SINGLES)
    lines = [
        "| task | method | trained for | minutes | all | First person | Third A | Third B |",
        "|" + "---|" * 8,
    ]
    for folder in BESIDE_IMAGINING:
        config, found = config_of(folder), evaluation(folder, development=True)
        training, streams = config["training"], config["streams"]
        # All of one camera is that camera alone.
        subset_of = {streams[0]: "all"} if len(streams) == 1 else {one: one for one in columns}
        rates = (rate(found, subset_of[one]) if one in subset_of else "–" for one in columns)
        done = (
            f"{training['steps']:,} decisions"
            if "steps" in training
            else f"{training['labelled_episodes']} episodes"
        )
        updates = f"{training['updates']:,} updates of {training['batch_size']}"
        minutes = round(training["wall_time_s"] / 60)
        lines.append(
            f"| {config['task']} | {config['method']} | {done}, {updates} | {minutes} | "
            f"{' | '.join(rates)} |"
        )
    return "\n".join(lines) + "\n"


def site_speed() -> str:
    """What a visitor of a site downloads, and how fast it acts, from results/site/speed.json."""
    found = json.loads((ROOT / "results" / "site" / "speed.json").read_text())
    lines = [
        f"{found['one_policy_mb']:.1f} MB until one policy acts, {found['first_load_mb']:.1f} MB "
        "until two do. Decisions per second:\n",
        "| OpenGL is computed by | one policy | two side by side, each |",
        "|---|---|---|",
    ]
    for backend, rates in found["decisions_per_s"].items():
        lines.append(f"| {backend} | {rates['one']:.1f} | {rates['side_by_side']:.1f} |")
    return "\n".join([*lines, f"\nOn {found['machine']}."]) + "\n"


def places() -> str:
    """What `benchmarks places` read from features of policies with a weak camera, from
    results/places, beside the success of each camera alone."""
    lines = [
        "| policy | camera | success alone | place | in its picture | from its feature | "
        "from the state | mean place |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for file in sorted((ROOT / "results" / "places").glob("*.json")):
        found = json.loads(file.read_text())
        alone = evaluation(found["policy"])["subsets"]
        for row in sorted(found["rows"], key=lambda row: SINGLES.index(row["stream"])):
            success, (low, high) = alone[row["stream"]]["success"], alone[row["stream"]]["ci95"]
            camera = f"{LABELS[row['stream']]} | {success:.2f} [{low:.2f}, {high:.2f}]"
            read = " | ".join(f"{row[of + '_cm']:.1f} cm" for of in ("feature", "state", "mean"))
            place = f"{row['place']} | {row['in_picture']:.2f}"
            lines.append(f"| {found['policy']} | {camera} | {place} | {read} |")
    return "\n".join(lines) + "\n"


def soaks() -> dict[str, dict[str, Any]]:
    """Pieces of `madviz soak`, from results/soak, by the name of their file."""
    files = sorted((ROOT / "results" / "soak").glob("*.json"))
    return {file.stem: json.loads(file.read_text()) for file in files}


def soak() -> str:
    """What the page's server took before and after each piece of `madviz soak`."""
    lines = [
        "| policy | workers | minutes | visits | controls used | memory after warm-up, at the end "
        "(MB) | an hour | threads | lines in the log |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for found in soaks().values():
        memory, threads = found["memory_mb"], found["threads"]
        before, after = memory["after_warm_up"], memory["end"]
        lines.append(
            f"| {found['policy']} | {found['workers']} | {found['minutes']:.0f} | "
            f"{found['visits']:,} | {found['touches']:,} | {before:.0f}, {after:.0f} | "
            f"{growth_an_hour(found):+.1f} MB | {threads['after_warm_up']}, {threads['end']} | "
            f"{found['log_lines']} |"
        )
    return "\n".join(lines) + "\n"


def machine() -> str:
    """Where benchmarks ran."""
    return json.loads((ROOT / "results" / "bench" / "machine.json").read_text())["machine"]


def site_success() -> str:
    """Success that `benchmarks site` counted in a browser, from results/site, beside Python's on
    the same seeds: one row for each policy and subset that was tried."""
    lines = [
        "| policy | cameras | in the browser | in Python | only browser, only Python | p |",
        "|---|---|---|---|---|---|",
    ]
    for file in sorted((ROOT / "results" / "site").glob("success-*.json")):
        played: dict[tuple[str, str], dict[int, bool]] = {}
        for one in json.loads(file.read_text())["episodes"]:
            played.setdefault((one["policy"], one["subset"]), {})[one["seed"]] = one["success"]
        for (policy, subset), browser in played.items():
            rows = (evaluation(policy), evaluation(policy, development=True))
            of_seed = {
                row["seed"]: row["success"]
                for found in rows
                for row in found["episodes"]
                if row["subset"] == subset
            }
            python = {seed: of_seed[seed] for seed in browser}
            rates = [SuccessRate.of(sum(one.values()), len(one)) for one in (browser, python)]
            compared = pair(browser, python)
            lines.append(
                f"| {policy} | {LABELS.get(subset, subset)} | {rates[0]} | {rates[1]} | "
                f"{compared.first_only}, {compared.second_only} | {compared.mcnemar():.2g} |"
            )
    return "\n".join(lines) + "\n"
