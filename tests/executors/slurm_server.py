"""Slurm on one computer, with its own key and folders, from Debian's package slurm-wlm, started for tests."""

import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NEEDED = ("munged", "slurmctld", "slurmd", "sbatch")
PARTITION, CPUS = "short", 4
_GIVE_UP_S = 120.0  # only what hangs takes so long
_CONFIGURATION = """
ClusterName=tests
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
SlurmctldPort={controller}
SlurmdPort={node}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=1,batch_sched_delay=0
ReturnToService=2
MpiDefault=none
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory=64000 State=UNKNOWN
PartitionName={partition} Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def lacking() -> str:
    """Return why Slurm cannot be started here; empty where it can."""
    missing = [program for program in NEEDED if shutil.which(program) is None]
    if missing:
        return f"Debian's slurm-wlm is not installed ({missing[0]})"
    return "" if os.geteuid() == 0 else "only root starts Slurm"


@contextmanager
def running() -> Iterator[dict[str, str]]:
    """Start Slurm; yield the environment in which its commands find it."""
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))  # a short path: that of a socket has at most 107 characters
    (folder / "state").mkdir()
    (folder / "spool").mkdir()
    key = folder / "key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o400)
    controller, node = _free_ports()
    configuration = folder / "slurm.conf"
    host = socket.gethostname().partition(".")[0]
    configuration.write_text(
        _CONFIGURATION.format(
            host=host, folder=folder, controller=controller, node=node, cpus=CPUS, partition=PARTITION
        )
    )
    environment = {**os.environ, "SLURM_CONF": str(configuration)}
    places = {
        name: folder / f"munge.{name.partition('-')[0]}" for name in ("socket", "pid-file", "log-file", "seed-file")
    }
    options = [f"--{name}={path}" for name, path in {**places, "key-file": key}.items()]
    munge = ["munged", "--foreground", "--force", *options]
    processes = []
    try:
        for command in (munge, ["slurmctld", "-D", "-c"], ["slurmd", "-D"]):
            with (folder / f"{command[0]}.output").open("wb") as output:
                processes.append(
                    subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
                )
        _wait(environment, folder)
        yield {"SLURM_CONF": str(configuration)}
    finally:
        subprocess.run(["scancel", "--user=root"], env=environment, check=False, capture_output=True)
        for process in reversed(processes):
            process.terminate()
        for process in reversed(processes):
            process.wait()
        shutil.rmtree(folder)


def _free_ports() -> list[int]:
    with socket.create_server(("127.0.0.1", 0)) as first, socket.create_server(("127.0.0.1", 0)) as second:
        return [server.getsockname()[1] for server in (first, second)]


def _wait(environment: dict[str, str], folder: Path) -> None:
    """Return when the node takes jobs."""
    began_s = time.monotonic()
    while time.monotonic() - began_s < _GIVE_UP_S:
        command = ["sinfo", "--noheader", "--format=%t"]
        node_state = subprocess.run(command, env=environment, check=False, capture_output=True, text=True)
        if node_state.stdout.strip() == "idle":
            return
        time.sleep(0.2)
    raise AssertionError("\n".join(file.read_text(errors="replace") for file in folder.glob("*.output")))
