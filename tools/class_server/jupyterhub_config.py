"""The hub's configuration. ``server.py start`` runs it, and says in the environment where it is."""

import os
import pwd
import secrets
import subprocess
from pathlib import Path

GIGABYTE = 1 << 30
MEMORY = 3 * GIGABYTE
"""Data of one process of a student's, at most. A cell that wants more stops with an error, and
nobody else's kernel does."""
PROCESSES = 400
"""Processes and threads of one student."""

prefix = Path(os.environ["MADVIZ_CLASS"])
c = get_config()  # noqa: F821  (JupyterHub's own.)

c.JupyterHub.bind_url = os.environ["MADVIZ_CLASS_ADDRESS"]
c.JupyterHub.db_url = f"sqlite:///{prefix}/state/hub.sqlite"
c.JupyterHub.cookie_secret_file = f"{prefix}/state/cookie_secret"
c.ConfigurableHTTPProxy.pid_file = f"{prefix}/state/proxy.pid"

# Who gets in: local accounts of this machine that belong to the class.
c.JupyterHub.authenticator_class = "pam"
c.PAMAuthenticator.allowed_groups = {"madviz-class"}
c.PAMAuthenticator.open_sessions = False

# A student's server: JupyterLab as that account, in ~/lessons.
c.JupyterHub.spawner_class = "jupyterhub.spawner.LocalProcessSpawner"
c.Spawner.cmd = [
    "prlimit", f"--data={MEMORY}", f"--nproc={PROCESSES}", "--core=0", "jupyterhub-singleuser",
]  # fmt: skip
c.Spawner.notebook_dir = "~/lessons"
c.Spawner.default_url = "/lab"
c.Spawner.start_timeout = 180
c.Spawner.http_timeout = 180
c.JupyterHub.concurrent_spawn_limit = 8


def temporary(spawner) -> Path:
    """Lessons keep trainings in a folder of one name; in /tmp it would be the first student's."""
    return Path(pwd.getpwnam(spawner.user.name).pw_dir, ".cache", "tmp")


c.Spawner.environment = {
    "TMPDIR": lambda spawner: str(temporary(spawner)),
    "JUPYTER_CONFIG_PATH": f"{prefix}/etc",
    "MADVIZ_CHECKPOINTS": f"{prefix}/policies/checkpoints",
    # Everybody on this machine reaches everybody's ports; a page asks for this token first.
    "MADVIZ_TOKEN": lambda spawner: secrets.token_urlsafe(16),
    # One core for each student; without this every kernel starts a thread for each core.
    "OMP_NUM_THREADS": "1",
    "LP_NUM_THREADS": "1",
    # Of glibc: threads share two heaps, else memory that one has freed is lost for the others.
    "MALLOC_ARENA_MAX": "2",
    # What a student installs for themselves does not change what the lessons run with.
    "PYTHONNOUSERSITE": "1",
    "MUJOCO_GL": "egl",
}


def hand_out(spawner) -> None:
    """Makes folders, and copies the lessons that a student does not have yet; as that student, so
    no link in their home leads anywhere that is not theirs."""
    user = pwd.getpwnam(spawner.user.name)
    for words in (
        ["cp", "--recursive", "--no-clobber", f"{prefix}/lessons", user.pw_dir],
        ["mkdir", "--parents", str(temporary(spawner))],
    ):
        subprocess.run(words, check=True, user=user.pw_uid, group=user.pw_gid, extra_groups=[])


c.Spawner.pre_spawn_hook = hand_out
