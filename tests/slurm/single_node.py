"""Three recordings through a real Slurm of one machine, and the same locally: whether all results are the same bytes.

    python tests/slurm/single_node.py [--install]

Run as root on Debian or Ubuntu. With --install Debian's `slurm-wlm` and `munge` are installed first where they are
missing. A controller, a node and munge are started in a folder and on ports of their own, without accounting, under
/etc/slurm/slurm.conf, which must not be there before; the workflow is run with `profiles/slurm`, then with `--cores 2`;
every file but the logs is compared; all that was started is stopped, and that file is taken away again. It is not
collected by pytest, since it needs root and two packages of the system.
"""

from __future__ import annotations

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
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from killed_runs import filmed, hashes

ROOT = Path(__file__).resolve().parents[2]
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
ETC = Path("/etc/slurm")
"""Where Slurm looks for its configuration; steps within jobs keep no variable that names another place."""


def free_ports(count: int) -> list[int]:
    """Ports that nothing listens on."""
    held = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [one.getsockname()[1] for one in held]
    for one in held:
        one.close()
    return ports


def installed(install: bool) -> None:
    """End with a sentence where Slurm is not there, or install it."""
    if install and not all(map(shutil.which, PROGRAMS)):
        packages = ["slurm-wlm", "munge"]
        quiet = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
        subprocess.run(["apt-get", "update", "-qq"], check=True, env=quiet)
        subprocess.run(["apt-get", "install", "-y", "-qq", "--no-install-recommends", *packages], check=True, env=quiet)
    if missing := [name for name in PROGRAMS if not shutil.which(name)]:
        raise SystemExit(f"not installed: {', '.join(missing)}. --install installs Debian's slurm-wlm and munge.")
    if (ETC / "slurm.conf").exists():
        raise SystemExit(f"{ETC / 'slurm.conf'} is there: this machine belongs to a cluster already.")
    if os.geteuid():
        raise SystemExit("Slurm's node starts jobs for others: run this as root.")


class Cluster:
    """Munge, a controller and one node, from `with` to its end."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.started = folder, []
        self.environment = os.environ | {"PYTHONPATH": str(ROOT)}

    def __enter__(self) -> Cluster:
        host = socket.gethostname().partition(".")[0]
        memory_MB = int(re.search(r"MemTotal:\s+(\d+)", Path("/proc/meminfo").read_text())[1]) // 1024 - 500  # type: ignore[index]
        for name in ("state", "spool", "munge"):
            (self.folder / name).mkdir()
        self.folder.chmod(0o755)
        text = CONFIGURATION.format(
            host=host, folder=self.folder, ports=free_ports(2), cpus=os.cpu_count(), memory_MB=memory_MB
        )
        ETC.mkdir(exist_ok=True)
        (ETC / "slurm.conf").write_text(text)
        try:
            self._munge()
            self._start("slurmctld", "-D")
            self._start("slurmd", "-D")
            self._until(lambda: "idle" in self._said("sinfo", "-h", "-o", "%T"), "the node is not idle")
        except BaseException:
            self.__exit__()
            raise
        return self

    def _munge(self) -> None:
        munge, owner = self.folder / "munge", pwd.getpwnam("munge")
        (munge / "key").write_bytes(secrets.token_bytes(256))
        (munge / "key").chmod(0o400)
        for path in (munge / "key", munge):
            os.chown(path, owner.pw_uid, owner.pw_gid)
        munge.chmod(0o755)
        files = [f"--{what}-file={munge / what}" for what in ("key", "log", "pid", "seed")]
        command = ["munged", "--foreground", *files, f"--socket={munge / 'socket'}"]
        self._start(*command, user="munge")
        self._until((munge / "socket").exists, "munge makes no socket")

    def _start(self, *command: str, user: str | None = None) -> None:
        with (self.folder / f"{command[0]}.log").open("wb") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, user=user, env=self.environment)
        self.started.append(process)

    def _said(self, *command: str) -> str:
        return subprocess.run(command, env=self.environment, capture_output=True, text=True, check=False).stdout

    def _until(self, true, otherwise: str, patience_s: float = 60.0) -> None:  # type: ignore[no-untyped-def]
        end = time.monotonic() + patience_s
        while not true():
            ended = [process.args[0] for process in self.started if process.poll() is not None]  # type: ignore[index]
            if ended or time.monotonic() > end:
                logs = "\n".join(f"{log.name}:\n{log.read_text()[-1500:]}" for log in self.folder.glob("*.log"))
                raise SystemExit(f"{otherwise}; ended: {ended}\n{logs}")
            time.sleep(0.2)

    def __exit__(self, *_: object) -> None:
        for process in reversed(self.started):
            process.terminate()
        for process in self.started:
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
        (ETC / "slurm.conf").unlink(missing_ok=True)


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
    installed(wanted.install)
    with tempfile.TemporaryDirectory(prefix="slurm-") as name:
        folder = Path(name)
        experiment = folder / "vines"
        with Cluster(folder) as cluster:
            filmed(experiment)
            profile = ["--workflow-profile", str(ROOT / "profiles" / "slurm")]
            there = run(folder / "cluster", experiment, cluster.environment, *profile, *OFTEN)
            jobs = re.findall(r"SLURM jobid '?(\d+)", (folder / "cluster" / "printed.txt").read_text())
        here = run(folder / "local", experiment, cluster.environment, "--cores", "2")
        one, other = hashes(there), hashes(here)
        names = sorted(one.keys() | other.keys())
        differing = [name for name in names if one.get(name) != other.get(name)]
        print(
            f"{len(set(jobs))} jobs of Slurm, {len(names)} files, {len(names) - len(differing)} of them the same bytes"
        )
        for name in differing:
            print(f"differs: {name}")
    raise SystemExit(1 if differing else 0)


if __name__ == "__main__":
    main()
