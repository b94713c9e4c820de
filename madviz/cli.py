"""``madviz COMMAND``: reads the command line, does the work, hands the result over.

The first word picks a line of ``commands.py``, and only then are its modules imported: ``madviz
--help`` needs neither torch nor viser. The options fill a frozen dataclass (tyro), one function
works on it, and what that returns is handed over.

    exit code 0 only for success; 1 something failed (doctor: something needed is missing);
    2 the user's own mistake, in one line and without a traceback; 130 Ctrl-C; 143 SIGTERM. A
    reader of standard output who leaves (``| head -1``) changes none of them
    --json FILE writes the result as JSON; --json - prints it, and then nothing else goes to
    standard output: whatever the work prints meanwhile, worker processes included, goes to stderr
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from madviz import __version__
from madviz.commands import COMMANDS, MOVED, OTHERS, Command
from madviz.errors import Interrupted, NotWritten, UserError, WithResult, saving, signal_of, unknown
from madviz.system.address import without_secrets
from madviz.system.files import pretty, write_json, written_to
from madviz.system.plugins import load
from madviz.system.signals import terminable
from madviz.system.streams import NOT_WRITTEN, open_standard_streams, say, telling


def main(
    words: Sequence[str] | None = None,
    commands: Mapping[str, Command] = COMMANDS,
    prog: str = "madviz",
) -> int:
    """Runs one command of the table ``commands``, whose program is started by ``prog``; returns the
    exit code."""
    open_standard_streams()
    if sys.platform == "linux":
        # MuJoCo reads this while it is imported, and its own default needs a display.
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        with terminable():
            written = sys.argv[1:] if words is None else words
            return run([without_secrets(word) for word in written], commands, prog)
    except UserError as error:
        say(f"madviz: {error}")
        return 2
    except Interrupted as stopped:
        say(f"madviz: stopped; {stopped}")
        return stopped.exit_code
    except KeyboardInterrupt as stopped:
        say("madviz: stopped")
        return 128 + signal_of(stopped)
    except OSError as error:
        if error.filename is None and error.errno not in NOT_WRITTEN:
            raise
        where = error.filename or "a file that it writes"
        say(f"madviz: {where!s:.200}: {error.strerror}")
        return 2


def run(words: Sequence[str], commands: Mapping[str, Command], prog: str) -> int:
    """Runs the command that the first word names; returns the exit code. Raises UserError for an
    unknown one."""
    first, rest = (words[0], words[1:]) if words else ("", ())
    if first in ("", "-h", "--help"):
        if not first:
            say(usage(commands, prog))
            return 2
        with telling():
            print(usage(commands, prog))
        return 0
    if first == "--version":
        with telling():
            print(f"madviz {__version__}")
        return 0
    if first == "--completion" and commands is COMMANDS:
        with telling():
            print(script_of(rest[0] if rest else ""))
        return 0
    if first in MOVED and commands is COMMANDS:
        raise UserError(f"{first} has moved: {MOVED[first].format(*rest[:1] or ['--help'])}")
    if first not in commands:
        raise unknown("command", first, list(commands))
    command = commands[first]
    try:
        if command.first:
            load(command.first)(rest)
        config = parse(first, rest, commands, prog)
        work = load(command.work)
        in_words = load(command.words) if command.words else None
    except KeyboardInterrupt as stopped:
        raise Interrupted("", signal_of(stopped)) from stopped
    return 0 if command.ok(deliver(config, work, in_words)) else 1


def usage(commands: Mapping[str, Command], prog: str) -> str:
    """A line for every command, and the options of ``madviz`` itself."""
    lines = [f"usage: {prog} COMMAND [options]     ({prog} COMMAND --help lists them)", ""]
    lines += [f"  {name:9} {command.summary}" for name, command in commands.items()]
    return "\n".join([*lines, "", *OTHERS] if commands is COMMANDS else lines)


def parse(
    name: str,
    words: Sequence[str],
    commands: Mapping[str, Command] = COMMANDS,
    prog: str = "madviz",
) -> Any:
    """The configuration of the command ``name``, filled from ``words``, or the end (``read``)."""
    command = commands[name]
    description = f"{command.summary}\n\nExample:\n  {prog} {command.example}"
    default = load(command.default)(words) if command.default else None
    config = load(command.config)
    from madviz.system.command_line import read  # With tyro, which madviz --help does without.

    return read(config, words, f"{prog} {name}", description, command.positional, default)


def script_of(shell: str) -> str:
    """The script by which ``shell`` completes what follows ``madviz``."""
    from madviz.system.command_line import completion

    configs = {name: load(command.config) for name, command in COMMANDS.items()}
    return completion(shell, "madviz", configs)


def deliver(
    config: Any, work: Callable[[Any], Any], in_words: Callable[[Any], str] | None = None
) -> Any:
    """Does ``work(config)`` and hands its result over: as JSON where ``config.json`` says if there
    is such an option, and printed by ``in_words``. Returns the result."""
    place: str | None = getattr(config, "json", None)
    if place == "-":
        with printing_to_stderr():
            result, unwritten = worked(config, work)
        with telling():
            sys.stdout.write(pretty(result))
    else:
        if place is not None:
            written_to(Path(place), "--json")
        result, unwritten = worked(config, work)
        if place is not None:
            try:
                with saving(result, f"--json {place}"):
                    write_json(Path(place), result)
            except NotWritten as error:
                unwritten = unwritten or error
        with telling():
            if in_words is not None:
                print(in_words(result))
            if isinstance(unwritten, NotWritten):
                sys.stdout.write(pretty(result))
    if unwritten:
        raise unwritten
    return result


def worked(config: Any, work: Callable[[Any], Any]) -> tuple[Any, WithResult | None]:
    """The result of ``work(config)``, also if some of it could not be written or is not there, and
    that error."""
    try:
        return work(config), None
    except WithResult as error:
        return error.result, error


@contextmanager
def printing_to_stderr() -> Iterator[None]:
    """Sends standard output to standard error meanwhile, also what C libraries and child processes
    print: the file descriptor itself is exchanged."""
    sys.stdout.flush()
    saved = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(saved, 1)
        os.close(saved)
