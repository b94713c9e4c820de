"""Sets up and runs a class server, a JupyterHub for students on one Debian machine:

    sudo python3 tools/class_server/server.py install              packages, once
    sudo python3 tools/class_server/server.py lessons build/class/student
    sudo python3 tools/class_server/server.py students --count 30  accounts and passwords
    sudo python3 tools/class_server/server.py start                the hub, until Ctrl-C
    sudo python3 tools/class_server/server.py service              or: the hub at every start
    sudo python3 tools/class_server/server.py collect 02_merge --out returned

Problem: thirty laptops differ, and 7 GB of packages for each are too much. Idea: one installation,
owned by root and read-only for everybody else, and what changes is in each student's home:

    /opt/madviz-class/venv      Python with madviz, JupyterLab and JupyterHub
                      node      the proxy in front of all servers (configurable-http-proxy, of npm)
                      lessons   the students' copies of the notebooks
                      policies  the checkpoints, and the tables of measured ones
                      etc       the two configurations beside this file, explained there
                      state     the hub's database and secrets; root alone reads it
    /home/student01/lessons     copied when the student's server starts; what is there stays

Students log in with a local account of this machine (PAM), a member of the group madviz-class. The
server of a student runs as that account, so the system keeps students apart. Standard library only:
this runs before there is an environment.
"""

from __future__ import annotations

import argparse
import csv
import grp
import json
import os
import pwd
import re
import secrets
import shutil
import stat
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parents[1]
PREFIX = Path("/opt/madviz-class")
GROUP = "madviz-class"
PROXY = "configurable-http-proxy@4"
CONFIGS = ("jupyterhub_config.py", "jupyter_server_config.py")
SETTINGS = {"@jupyterlab/apputils-extension:notification": {"fetchNews": "false"}}
"""Of every student's JupyterLab: it does not ask who wants to read news."""
NAME = re.compile(r"[a-z][a-z0-9-]{0,30}")
LETTERS = "abcdefghijkmnpqrstuvwxyz23456789"
"""Of passwords: none that look alike."""
LARGEST = 50 << 20
"""Bytes of a notebook that is collected."""


class Complaint(Exception):
    """A mistake of the user's, in one line."""


def run(*words: str | Path, **options) -> None:
    """Runs a command; its output goes to the terminal. Raises CalledProcessError."""
    print("+", *words, flush=True)
    subprocess.run([str(word) for word in words], check=True, **options)


def install(prefix: Path) -> None:
    """System libraries, the environment, the proxy and the configurations."""
    run(sys.executable, REPOSITORY / "tools" / "system.py", "--node")
    venv, node = prefix / "venv", prefix / "node"
    if not (venv / "bin" / "python").exists():
        if hidden := out_of_reach(Path(sys.executable).resolve()):
            raise Complaint(
                f"expected a Python that every account can start, found one below {hidden}; "
                "run this again with /usr/bin/python3"
            )
        run(sys.executable, "-m", "venv", venv)
    pip = (venv / "bin" / "python", "-m", "pip", "install", "--disable-pip-version-check")
    constraints = ("--constraint", REPOSITORY / "constraints.txt")
    if index := os.environ.get("TORCH_INDEX"):
        run(*pip, *constraints, "--index-url", index, "torch")
    run(*pip, *constraints, f"{REPOSITORY}[notebooks]", "jupyterhub>=5,<7")
    node.mkdir(parents=True, exist_ok=True)
    run("npm", "install", "--prefix", node, "--ignore-scripts", "--no-audit", "--no-fund", PROXY)
    configure(prefix)


def out_of_reach(file: Path) -> Path | None:
    """The folder on the way to ``file`` that other accounts may not enter; None if they may all."""
    return next((one for one in file.parents if not one.stat().st_mode & stat.S_IXOTH), None)


def configure(prefix: Path) -> None:
    """The hub's files, policies and the group: quick, and may be repeated."""
    (prefix / "state").mkdir(parents=True, exist_ok=True, mode=0o700)
    etc = prefix / "etc"
    etc.mkdir(exist_ok=True)
    for name in CONFIGS:
        shutil.copyfile(HERE / name, etc / name)
    settings = prefix / "venv/share/jupyter/lab/settings"
    settings.mkdir(parents=True, exist_ok=True)
    (settings / "overrides.json").write_text(json.dumps(SETTINGS))
    for name in ("checkpoints", "results/tables"):
        target = prefix / "policies" / name
        shutil.copytree(REPOSITORY / name, target, dirs_exist_ok=True)
    if GROUP not in [group.gr_name for group in grp.getgrall()]:
        run("groupadd", GROUP)


def lessons(prefix: Path, copies: Path) -> None:
    """Takes over the students' copies; later servers of students get them."""
    if not list(copies.glob("*.ipynb")):
        raise Complaint(f"expected notebooks in {copies}, found none; run: make student-copies")
    shutil.rmtree(prefix / "lessons", ignore_errors=True)
    shutil.copytree(copies, prefix / "lessons")


def students(names: list[str], passwords: Path) -> None:
    """Makes an account for every name that has none, and adds the others to the class. The password
    of a new account is in the file ``passwords`` at once, so that none is lost where a later one
    fails; an account that could not get one is removed again."""
    if wrong := [name for name in names if not NAME.fullmatch(name)]:
        raise Complaint(f"expected names such as student01, found {wrong[0]!r}; change it")
    known = {user.pw_name for user in pwd.getpwall()}
    made = 0
    private = os.open(passwords, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    with open(private, "a", newline="") as file:
        for name in names:
            if name in known:
                run("usermod", "--append", "--groups", GROUP, name)
                continue
            words = ("--create-home", "--groups", GROUP, "--shell", "/bin/bash")
            run("useradd", *words, "--key", "HOME_MODE=0700", name)
            password = "".join(secrets.choice(LETTERS) for _ in range(10))
            try:
                run("chpasswd", input=f"{name}:{password}\n", text=True)
                csv.writer(file).writerow((name, password))
                file.flush()
            except BaseException:
                run("userdel", "--remove", name)
                raise
            made += 1
    print(f"{made} accounts made; their passwords are in {passwords}")


def hub_command(prefix: Path) -> list[str]:
    return [str(prefix / "venv/bin/jupyterhub"), "--config", str(prefix / "etc" / CONFIGS[0])]


def environment(prefix: Path, address: str, port: int) -> dict[str, str]:
    """What the hub's configuration reads."""
    paths = [str(prefix / "venv/bin"), str(prefix / "node/node_modules/.bin")]
    return {
        "PATH": os.pathsep.join([*paths, "/usr/local/bin", "/usr/bin", "/bin"]),
        "MADVIZ_CLASS": str(prefix),
        "MADVIZ_CLASS_ADDRESS": f"http://{address}:{port}",
    }


def start(prefix: Path, address: str, port: int) -> None:
    """Becomes the hub."""
    os.chdir(prefix / "state")
    words = hub_command(prefix)
    os.execve(words[0], words, {"LANG": "C.UTF-8", **environment(prefix, address, port)})


def service(prefix: Path, address: str, port: int, folder: Path) -> None:
    """Writes a unit for systemd."""
    lines = [
        f'Environment="{key}={value}"' for key, value in environment(prefix, address, port).items()
    ]
    unit = "\n".join([
        "[Unit]", "Description=The class server of madviz", "After=network.target", "",
        "[Service]", f"WorkingDirectory={prefix}/state", *lines,
        f"ExecStart={' '.join(hub_command(prefix))}", "Restart=on-failure", "",
        "[Install]", "WantedBy=multi-user.target", "",
    ])  # fmt: skip
    file = folder / "madviz-class.service"
    file.write_text(unit)
    print(f"written: {file}. To start it now and at every start of the machine:")
    print("    systemctl daemon-reload && systemctl enable --now madviz-class")


def collect(lesson: str, out: Path) -> None:
    """Copies everybody's notebook of ``lesson`` to OUT/STUDENT/LESSON.ipynb, and says who has
    none. A student could put a link to another file there: links are not followed."""
    missing = []
    for name in sorted(grp.getgrnam(GROUP).gr_mem):
        home = Path(pwd.getpwnam(name).pw_dir)
        text = contents(home / "lessons", f"{lesson}.ipynb")
        if text is None:
            missing.append(name)
            continue
        (out / name).mkdir(parents=True, exist_ok=True)
        (out / name / f"{lesson}.ipynb").write_bytes(text)
    print(f"collected in {out}; without this lesson: {', '.join(missing) or 'nobody'}")


def contents(folder: Path, name: str) -> bytes | None:
    """A plain file of ``folder``, neither of which may be a link."""
    try:
        inside = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=inside)
    except OSError:
        return None
    finally:
        os.close(inside)
    with open(file, "rb") as opened:
        kind = os.fstat(opened.fileno())
        fits = stat.S_ISREG(kind.st_mode) and kind.st_nlink == 1 and kind.st_size <= LARGEST
        return opened.read() if fits else None


def arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="A JupyterHub for a class, on one Debian machine.")
    parser.add_argument("--prefix", type=Path, default=PREFIX, help=f"where; default {PREFIX}")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("install", help="packages, proxy and configuration")
    commands.add_parser("configure", help="only the configuration and the policies")
    taken = commands.add_parser("lessons", help="takes over the students' copies")
    taken.add_argument("copies", type=Path, help="build/class/student")
    class_list = commands.add_parser("students", help="makes accounts")
    class_list.add_argument("--count", type=int, default=0, help="student01, student02, …")
    class_list.add_argument("--names", type=Path, help="a file with an account's name in each line")
    class_list.add_argument("--passwords", type=Path, default=Path("passwords.csv"))
    for name in ("start", "service"):
        one = commands.add_parser(
            name, help="runs the hub" if name == "start" else "a systemd unit"
        )
        one.add_argument("--address", default="", help="where to listen; default: everywhere")
        one.add_argument("--port", type=int, default=8000)
    commands.choices["service"].add_argument(
        "--folder", type=Path, default=Path("/etc/systemd/system")
    )
    returned = commands.add_parser("collect", help="copies everybody's notebook of a lesson")
    returned.add_argument("lesson", help="for example 02_merge")
    returned.add_argument("--out", type=Path, default=Path("returned"))
    return parser


def main() -> int:
    given = arguments().parse_args()
    os.umask(0o022)
    try:
        if os.geteuid() != 0:
            raise Complaint(
                f"expected root, found {os.environ.get('USER', 'another user')}; use sudo"
            )
        match given.command:
            case "install":
                install(given.prefix)
            case "configure":
                configure(given.prefix)
            case "lessons":
                lessons(given.prefix, given.copies)
            case "students":
                listed = given.names.read_text().split() if given.names else []
                students(
                    listed + [f"student{i:02}" for i in range(1, given.count + 1)], given.passwords
                )
            case "start":
                start(given.prefix, given.address, given.port)
            case "service":
                service(given.prefix, given.address, given.port, given.folder)
            case "collect":
                collect(given.lesson, given.out)
    except (Complaint, OSError, subprocess.CalledProcessError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
