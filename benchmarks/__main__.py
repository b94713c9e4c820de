"""``python -m benchmarks NAME``, in a clone of the repository: runs one benchmark.

Its options are read, and its result is handed over, as for a command of ``madviz``.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter

from madviz import cli
from madviz.commands import Command

PROGRAM = "python -m benchmarks"
PRETTY = "madviz.system.files:pretty"
BENCHMARKS: dict[str, Command] = {
    "render": Command(
        "A three-view frame against the simulator's stock settings.",
        "render --suite metaworld",
        config="benchmarks.render:RenderConfig",
        work="benchmarks.render:bench_render",
        words=PRETTY,
    ),
    "live": Command(
        "The page in a real browser: updates a second, and how long a toggle takes.",
        "live --seconds 10 --toggles 30",
        config="benchmarks.live:LiveConfig",
        work="benchmarks.live:bench_live",
        words=PRETTY,
    ),
    "waits": Command(
        "What people wait for: the first picture, another task, a first cell, a command.",
        "waits --suite metaworld --rounds 3",
        config="benchmarks.waits:WaitsConfig",
        work="benchmarks.waits:bench_waits",
        words=PRETTY,
    ),
    "crowd": Command(
        "Visitors with a simulation each: decisions a second, cores, memory.",
        "crowd --visitors 1 4 8",
        config="benchmarks.crowd:CrowdConfig",
        work="benchmarks.crowd:bench_crowd",
        words=PRETTY,
    ),
    "soak": Command(
        "Lets visitors come and go for an hour; says whether the server has grown.",
        "soak --minutes 3 --visitors 2",
        config="benchmarks.soak:SoakConfig",
        work="benchmarks.soak:soak",
        words="benchmarks.soak:soak_words",
        ok=itemgetter("ok"),
    ),
    "imagine": Command(
        "What a masked autoencoder draws of a camera that is missing, against two controls.",
        "imagine --task toy/reach --training.updates 2000",
        config="benchmarks.imagine:ImagineConfig",
        work="benchmarks.imagine:bench_imagine",
        words="benchmarks.imagine:imagine_words",
    ),
    "places": Command(
        "Where the task's objects are, read from each camera's feature, against two controls.",
        "places --policy metaworld-hammer-mad-light",
        config="benchmarks.places:PlacesConfig",
        work="benchmarks.places:bench_places",
        words="benchmarks.places:places_words",
    ),
    "update": Command(
        "One training update against a straightforward implementation.",
        "update --batch-size 64 --hidden-dim 512",
        config="benchmarks.update:BenchUpdateConfig",
        work="benchmarks.update:bench_update",
        words=PRETTY,
    ),
    "buffer": Command(
        "The replay buffer packed against plain: bytes per transition, time for a batch.",
        "buffer --decisions 400 --rounds 5",
        config="benchmarks.buffer:BenchBufferConfig",
        work="benchmarks.buffer:bench_buffer",
        words=PRETTY,
    ),
    "recordings": Command(
        "Films of a robot: decoding, a round of training, and memory.",
        "recordings --episodes 50 --lerobot integrations/lerobot/.venv/bin/python",
        config="benchmarks.recordings:BenchRecordingsConfig",
        work="benchmarks.recordings:bench_recordings",
        words=PRETTY,
    ),
    "evaluate": Command(
        "Episodes a minute of an evaluation, against a plain loop and a stock one.",
        "evaluate --episodes 8 --workers 2",
        config="benchmarks.evaluate:BenchEvaluateConfig",
        work="benchmarks.evaluate:bench_evaluate",
        words=PRETTY,
    ),
    "guard": Command(
        "What a guard costs in one step of three cameras.",
        "guard --size 84",
        config="benchmarks.guard:BenchGuardConfig",
        work="benchmarks.guard:bench_guard",
        words=PRETTY,
    ),
    "guard-trial": Command(
        "Success with a guard and without, for every failure of every camera; resumes.",
        "guard-trial --policies metaworld-hammer-mad-light --out build/guard",
        config="benchmarks.guard_trial:GuardTrialConfig",
        work="benchmarks.guard_trial:guard_trial",
        words="benchmarks.guard_trial:trial_words",
    ),
    "guard-alarms": Command(
        "How soon a guard notices each failure, and its false alarms; resumes.",
        "guard-alarms --policies metaworld-hammer-mad-light --out build/guard",
        config="benchmarks.guard_alarms:GuardAlarmsConfig",
        work="benchmarks.guard_alarms:guard_alarms",
        words="benchmarks.guard_alarms:alarms_words",
    ),
    "site": Command(
        "A site in a real browser: megabytes, decisions a second, success by subset.",
        "site --site build/site --episodes 20",
        config="benchmarks.site:BenchSiteConfig",
        work="benchmarks.site:bench_site",
        words=PRETTY,
    ),
}
"""A line for each, in the order of ``python -m benchmarks --help``."""


def main(words: Sequence[str] | None = None) -> int:
    """Runs one benchmark; returns the exit code, as ``madviz.cli.main`` does."""
    return cli.main(words, BENCHMARKS, PROGRAM)


if __name__ == "__main__":
    raise SystemExit(main())
