"""SLURM on this machine: munged, slurmctld and two slurmd on loopback, with their files in a temporary directory."""

from __future__ import annotations

import contextlib
import getpass
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from command_line import REPOSITORY, environment

PATH = f"{os.environ['PATH']}:/usr/sbin:/sbin"
PROGRAMS = ("munged", "slurmctld", "slurmd", "srun", "sbatch")
NODES = ("127.0.0.1", "127.0.0.2")  # named by addresses, so that JAX finds the first one's coordinator
# What is in `high` puts off what is in `low`, which may run again 5 s later, the least that SLURM takes.
SETTINGS = """
ClusterName=mjxball
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
CredType=cred/munge
AuthInfo=socket={place}/munge.socket,cred_expire=5
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
StateSaveLocation={place}/state
SlurmdSpoolDir={place}/spool-%n
SlurmctldPidFile={place}/slurmctld.pid
SlurmdPidFile={place}/slurmd-%n.pid
SlurmctldLogFile={place}/slurmctld.log
SlurmdLogFile={place}/slurmd-%n.log
ProctrackType=proctrack/pgid
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
SchedulerParameters=bf_interval=1,sched_interval=1
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
KillWait=60
NodeName={nodes[0]} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=1
NodeName={nodes[1]} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=1
PartitionName=low Nodes=ALL Default=YES PriorityTier=1
PartitionName=high Nodes=ALL PriorityTier=2 PreemptMode=OFF
"""


def free_ports(number: int) -> list[int]:
    """Ports of loopback that nobody uses."""
    with contextlib.ExitStack() as stack:
        found = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(number)]
        return [one.getsockname()[1] for one in found]


def wait_until(done: Callable[[], Any], seconds: float = 30.0) -> None:
    """Return once `done()` is true; TimeoutError if that takes longer."""
    deadline = time.monotonic() + seconds
    while not done():
        if time.monotonic() > deadline:
            raise TimeoutError(f"not within {seconds:.0f} s")
        time.sleep(0.1)


def missing() -> list[str]:
    """What is not installed of SLURM and MUNGE."""
    return [program for program in PROGRAMS if shutil.which(program, path=PATH) is None]


class Cluster:
    """Calls SLURM's commands in the repository."""

    def __init__(self, place: Path):
        self.place = place
        self.environment = {
            **environment(),
            **{"PATH": PATH, "SLURM_CONF": str(place / "slurm.conf"), "PYTHONPATH": str(REPOSITORY)},
        }

    def call(self, *command: object, timeout: float = 200) -> subprocess.CompletedProcess[str]:
        """Run `command` to its end."""
        words = list(map(str, command))
        return subprocess.run(
            words, cwd=REPOSITORY, env=self.environment, capture_output=True, text=True, timeout=timeout, check=False
        )

    def submit(self, script: str, *options: str) -> str:
        """The number of the job that runs the lines of bash `script`; what it prints goes to `output`."""
        path = self.place / "job.sh"
        path.write_text(f"#!/bin/bash\n{script}\n")
        done = self.call("sbatch", "--parsable", "--open-mode=append", f"--output={self.place}/%j.out", *options, path)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def states(self, job: str) -> set[str]:
        """SLURM's words, such as PENDING or COMPLETED, for the job or the tasks of an array."""
        return set(self.call("squeue", "--noheader", "--states=all", "--format=%T", f"--jobs={job}").stdout.split())

    def wait_for(self, job: str, seconds: float) -> None:
        """Return when the job has succeeded; AssertionError with what it printed if it fails."""
        wait_until(lambda: self.states(job) <= {"COMPLETED", "FAILED"}, seconds)
        assert self.states(job) == {"COMPLETED"}, self.output(job)

    def output(self, job: str) -> str:
        """What a job, or all tasks of an array, printed."""
        return "".join(path.read_text() for path in sorted(self.place.glob(f"{job}*.out")))


@contextlib.contextmanager
def cluster() -> Iterator[Cluster]:
    """Two nodes of one CPU, ready; their daemons end with the context."""
    with contextlib.ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="slurm-")))
        place.chmod(0o711)  # MUNGE wants its socket within everyone's reach
        key = place / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o600)
        (place / "state").mkdir()
        user = getpass.getuser()
        settings = SETTINGS.format(place=place, user=user, nodes=NODES, ports=free_ports(3))
        (place / "slurm.conf").write_text(settings)
        made = Cluster(place)

        def start(*command: str) -> None:
            daemon = subprocess.Popen(
                command, env=made.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            stack.callback(daemon.wait, 30)
            stack.callback(daemon.terminate)

        files = [f"--{name}-file={place}/munge.{name}" for name in ("key", "pid", "log", "seed")]
        start("munged", "--foreground", f"--socket={place}/munge.socket", *files)
        wait_until((place / "munge.socket").exists)
        start("slurmctld", "-D")
        for node in NODES:
            start("slurmd", "-D", "-N", node)
        wait_until(lambda: made.call("sinfo", "--noheader", "--states=idle", "--format=%D").stdout.split()[:1] == ["2"])
        stack.callback(wait_until, lambda: not made.call("squeue", "--noheader").stdout)
        stack.callback(made.call, "scancel", f"--user={user}")  # those that wait
        stack.callback(made.call, "scancel", "--full", "--signal=KILL", f"--user={user}")
        yield made
