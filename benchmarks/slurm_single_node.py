"""Three recordings through a real Slurm of one machine, and the same locally: whether all results are the same bytes.

    python benchmarks/slurm_single_node.py [--install]

Run as root on Debian or Ubuntu. With --install Debian's `slurm-wlm` and `munge` are installed first where they are
missing. A controller, a node and munge are started in a folder and on ports of their own, without accounting, under
/etc/slurm/slurm.conf, which must not be there before; the workflow is run with `profiles/slurm`, then with `--cores 2`;
every file but the logs is compared; all that was started is stopped, and that file is taken away again.
"""

import argparse
import os
import pwd
import re
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from killed_runs import filmed, hashes

ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "sinfo")
CONFIGURATION = """\
ClusterName=single
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory={memory_MB} State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
OFTEN = ("--slurm-init-seconds-before-status-checks", "3", "--seconds-between-status-checks", "2")
"""How soon and how often jobs are asked after: chosen, jobs of this experiment take seconds."""
CONF = Path("/etc/slurm/slurm.conf")
"""Where Slurm looks for its configuration; steps within jobs keep no variable that names another place."""


def check_machine(install: bool) -> None:
    """End with a sentence where Slurm is not there, or install it."""
    if install and not all(map(shutil.which, PROGRAMS)):
        quiet = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
        for command in ("update -qq", "install -y -qq --no-install-recommends slurm-wlm munge"):
            subprocess.run(["apt-get", *command.split()], check=True, env=quiet)
    if missing := [name for name in PROGRAMS if not shutil.which(name)]:
        raise SystemExit(f"not installed: {', '.join(missing)}. --install installs Debian's slurm-wlm and munge.")
    if CONF.exists():
        raise SystemExit(f"{CONF} is there: this machine belongs to a cluster already.")
    if os.geteuid():
        raise SystemExit("Slurm's node starts jobs for others: run this as root.")


@contextmanager
def cluster(folder: Path) -> Iterator[dict[str, str]]:
    """Munge, a controller and one node; the environment of what is to use them."""
    environment, started = os.environ | {"PYTHONPATH": str(ROOT)}, []

    def start(*command: str, user: str | None = None) -> None:
        with (folder / f"{command[0]}.log").open("wb") as log:
            started.append(subprocess.Popen(command, stdout=log, stderr=log, user=user, env=environment))

    def until(true: Callable[[], bool], otherwise: str) -> None:
        end = time.monotonic() + 60
        while not true():
            ended = [process.args[0] for process in started if process.poll() is not None]
            if ended or time.monotonic() > end:
                logs = "\n".join(f"{log.name}:\n{log.read_text()[-1500:]}" for log in folder.glob("*.log"))
                raise SystemExit(f"{otherwise}; ended: {ended}\n{logs}")
            time.sleep(0.2)

    def is_idle() -> bool:
        command = ["sinfo", "-h", "-o", "%T"]
        return "idle" in subprocess.run(command, env=environment, capture_output=True, text=True, check=False).stdout

    held = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
    ports = [one.getsockname()[1] for one in held]  # that nothing listens on
    for one in held:
        one.close()
    host = socket.gethostname().partition(".")[0]
    memory_MB = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20 - 500
    text = CONFIGURATION.format(host=host, folder=folder, ports=ports, cpus=os.cpu_count(), memory_MB=memory_MB)
    for name in ("state", "spool", "munge"):
        (folder / name).mkdir()
    folder.chmod(0o755)
    munge, owner = folder / "munge", pwd.getpwnam("munge")
    (munge / "key").write_bytes(secrets.token_bytes(256))
    (munge / "key").chmod(0o400)
    for path in (munge / "key", munge):
        os.chown(path, owner.pw_uid, owner.pw_gid)
    munge.chmod(0o755)
    CONF.parent.mkdir(exist_ok=True)
    CONF.write_text(text)
    try:
        files = [f"--{what}-file={munge / what}" for what in ("key", "log", "pid", "seed")]
        start("munged", "--foreground", *files, f"--socket={munge / 'socket'}", user="munge")
        until((munge / "socket").exists, "munge makes no socket")
        start("slurmctld", "-D")
        start("slurmd", "-D")
        until(is_idle, "the node is not idle")
        yield environment
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
        CONF.unlink(missing_ok=True)


def run(folder: Path, experiment: Path, environment: dict[str, str], *options: str) -> Path:
    """The workflow, in a folder of its own; its results."""
    folder.mkdir()
    begun = time.monotonic()
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile"), "--directory", str(folder)]
    done = subprocess.run(
        [*command, *options, "--config", f"experiment={experiment}"],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
    )  # fmt: skip
    (folder / "printed.txt").write_text(done.stdout)
    if done.returncode:
        raise SystemExit(f"{' '.join(options)} ended with {done.returncode}:\n{done.stdout[-4000:]}")
    print(f"{time.monotonic() - begun:6.0f} s  {' '.join(options)}", flush=True)
    return folder / "results" / experiment.name


def main() -> None:
    """Start, run, compare, stop; exit 1 where anything differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--install", action="store_true", help="Debian's slurm-wlm and munge, where they are missing")
    wanted = parser.parse_args()
    check_machine(wanted.install)
    with tempfile.TemporaryDirectory(prefix="slurm-") as name:
        folder, experiment = Path(name), Path(name) / "vines"
        with cluster(folder) as environment:
            filmed(experiment)
            profile = ["--workflow-profile", str(ROOT / "profiles" / "slurm")]
            there = run(folder / "cluster", experiment, environment, *profile, *OFTEN)
            jobs = set(re.findall(r"SLURM jobid '?(\d+)", (folder / "cluster" / "printed.txt").read_text()))
        here = run(folder / "local", experiment, environment, "--cores", "2")
        one, other = hashes(there), hashes(here)
    names = sorted(one.keys() | other.keys())
    differing = [name for name in names if one.get(name) != other.get(name)]
    print(f"{len(jobs)} jobs of Slurm, {len(names)} files, {len(names) - len(differing)} of them the same bytes")
    print("".join(f"differs: {name}\n" for name in differing), end="")
    raise SystemExit(1 if differing else 0)


if __name__ == "__main__":
    main()
