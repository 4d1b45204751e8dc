"""A training run on the host: run directory, chunks of compiled work, evaluations, checkpoints, Ctrl-C."""

from __future__ import annotations

import contextlib
import math
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjxball.config import Config
from mjxball.errors import TrainingDivergedError
from mjxball.policy import save_file
from mjxball.policy.export import is_sound, network_file, policy_file
from mjxball.sim.follower import network_interface
from mjxball.train import lock, processes
from mjxball.train import program as programs
from mjxball.train.curves import MemberLog, training_summary
from mjxball.train.environments import Statistics
from mjxball.train.events import session
from mjxball.train.extensions import Extensions, is_transport_env, resolve
from mjxball.train.population import Population
from mjxball.train.program import Mode, TrainState
from mjxball.train.progress import Progress, Row, Start, columns, started
from mjxball.train.run_directory import CONFIG_FILE, METRICS, POLICY, start_policy, starts_of, write_config

SAVE_EVERY = 60.0  # [s] since the last checkpoint after which the next row is followed by one


@dataclass
class Stop:
    """Request to stop, set by the first Ctrl-C.

    Training ends after the current collection; with several processes, after the current chunk.
    """

    requested: bool = False
    begun: bool = False  # training has begun, so there is a state to save


@contextlib.contextmanager
def graceful_interrupt(progress: Progress) -> Iterator[Stop]:
    """Turn the first Ctrl-C or SIGTERM into a request to stop. Before training, and at the second Ctrl-C, exit at once.

    A second SIGTERM is ignored: SLURM sends it twice to preempted jobs, once directly and once through srun.
    """
    stop = Stop()
    defaults = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, default in defaults.items():
            signal.signal(number, default)

    def handler(number: int, frame: Any) -> None:
        stop.requested = True
        restore()
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if not stop.begun and jax.process_count() == 1:
            progress.end_status()
            progress.say("stopped before training began, with exit code 130; --resume begins it")
            lock.drop()
            os._exit(130)  # XLA's compilation cannot be interrupted
        progress.end_status()  # now, because a second Ctrl-C exits at once
        progress.say("stopping: saving the policy and a checkpoint (Ctrl-C again to quit at once)")

    for number in defaults:
        signal.signal(number, handler)
    try:
        yield stop
    finally:
        restore()


@dataclass
class Chunk:
    """Training submitted to the devices, and its results, which become a row of metrics.csv."""

    steps: int  # of each environment
    reached: int  # environment steps of the run at the chunk's end
    began: float  # time of submission since the run's start [s]
    ended: Future[float]  # time when the devices finish [s]
    statistics: Statistics  # on the devices
    metrics: Any


class Run:
    """A training with its run directory, driven by `mjxball.train.loop.train`.

    With several processes each makes the same `Run`; only process 0 writes and prints.
    """

    def __init__(
        self,
        config: Config,
        out: Path,
        origin: dict[str, Any],
        resumed: TrainState | None,
        tracker: Start | None = None,
        began: float | None = None,
    ):
        """`resumed`: the state to continue from, None for a new run. `tracker`: see `mjxball.train.progress.Start`.

        `origin` holds seed, physics, seeds (number of members) and sweep, and goes into the metadata of the policy. A
        new run starts from the policy `origin["start_from"]` if there is one, or each member from its entry of a list.
        With `origin["minutes"]` it takes as many steps as it can in that time since `began`, a monotonic time [s].
        """
        self.config, self.out = config, out
        self._starts = starts_of(origin)
        self._policies = [start_policy(start, config) for start in self._starts] if resumed is None else []
        extensions = resolve(Extensions(**(origin.get("extensions") or {})))
        self.population = Population(config, origin["physics"], origin["seeds"], origin["sweep"], extensions=extensions)
        self._schedule = self.population.program.schedule
        kind = jax.devices()[0].device_kind
        hardware = f"{os.cpu_count()} CPU cores" if kind == "cpu" else f"{self.population.devices} x {kind}"
        self.origin = {**origin, "parts": self.population.parts, "hardware": hardware}
        self._writes = processes.is_writer()
        self._reached = done = _count(resumed) if resumed else 0  # environment steps, the same for every member
        whole = session(config, origin["seed"], origin["seeds"], origin)
        log = started(tracker, whole) if tracker is not None and self._writes else None
        if self._writes:
            out.mkdir(parents=True, exist_ok=True)
            if not (out / CONFIG_FILE).exists():
                write_config(out, config, self.origin)
        exploring, evaluated = self.population.metric_names()
        names = columns(exploring, self.population.program.algorithm.metrics, evaluated)
        place, seed, count = out / METRICS, origin["seed"], origin["seeds"]
        total = self._schedule.total_steps if resumed is None else self.population.total_steps(resumed)
        self.progress = Progress(place if self._writes else None, names, total, done, count, session=whole, tracker=log)
        sessions = [session(self.population.member_config(k), seed + k, 1, origin) for k in range(count)]
        minutes: float | None = origin.get("minutes")
        begun = time.monotonic() if began is None else began
        self._ends = self.progress.ends = None if minutes is None else begun + 60 * minutes - self.progress.before
        self.members = MemberLog(out if self._writes else None, sessions if count > 1 else (), seed, done)
        self.on_traced: Callable[[], None] | None = None  # is called when XLA compiles, which leaves Python free
        self.on_evaluated: Callable[[Path], None] | None = None  # is called with the policy file after an evaluation
        self._writer = ThreadPoolExecutor(1)  # writes checkpoints
        self._clock = ThreadPoolExecutor(1)  # waits for the devices to take the time
        self._checkpoints: Future[Any] | None = None
        self._pending: Future[None] | None = None
        self._state = resumed
        self._saved_at = self._saving = self._chunk_ended = 0.0  # [s]
        self._saved_steps = -1

    @property
    def state(self) -> TrainState:
        """Training state. RuntimeError before `start`, unless the run was resumed."""
        if self._state is None:
            raise RuntimeError("the run has not started")
        return self._state

    @state.setter
    def state(self, state: TrainState) -> None:
        self._state = state

    def start(self) -> None:
        """Compile, and create the initial state, or place the resumed state on the devices."""
        devices = self.population.devices
        kind = jax.devices()[0].device_kind
        what = f"the training program for {'the CPU' if kind == 'cpu' else f'{devices} x {kind}'}"
        self.progress.begin("compiling", what, "Ctrl-C stops")
        creating = self._state is None
        self._compiled = self.population.compile(creating)
        if self.on_traced:
            self.on_traced()
        if creating:
            self.state = self.population.start(self._compiled, self.origin["seed"])
            if self._policies:
                self.state = self.population.start_from(self.state, self._policies)
            self._export()
        else:
            self.state = self.population.place_state(self.state)
        self._compiled.wait()
        if self._writes:  # Orbax takes a second to import, which overlaps with training here
            self._checkpoints = self._writer.submit(_open_checkpoints, self.out)
        self.progress.say(f"compiled in {self.progress.elapsed():.1f} s")
        left = self.seconds_left()
        if left is not None and left < self.progress.elapsed():
            self.progress.say(
                f"that leaves {left:.0f} s of --minutes to train; compiled programs are kept, so the same command "
                "trains longer the next time"
            )
        self.progress.begin("training")

    def end(self, finished: bool) -> None:
        """Save, delete all but the newest checkpoint if training has `finished`, and print time and memory."""
        self.save()
        if self._pending and finished:
            self._pending = self._writer.submit(_keep_newest, self._pending, self._checkpoints)
        self.progress.say(self._cost())

    def close(self) -> None:
        """Wait until every checkpoint is on disk."""
        with self._clock, self._writer:
            try:
                if self._pending:
                    self._pending.result()
            finally:
                if self._checkpoints:
                    self._checkpoints.result().close()

    def _cost(self) -> str:
        """Peak memory and time of the run as a sentence, which `benchmarks/training.py` parses."""
        host = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
        device = (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
        more = f", {device / 1e6:.0f} MB on each device" if device else ""
        return f"peak memory {host:.0f} MB{more}; saving took {self._saving:.2f} of {self.progress.elapsed():.1f} s"

    @property
    def done(self) -> int:
        """Steps that each environment has taken, including the warm-up."""
        return self._reached // self._schedule.num_envs

    def advance(self, mode: Mode, pause: Callable[[], bool] = lambda: False) -> Chunk:
        """Submit the steps of `mode` to the devices; fewer if `pause` returns true."""
        began = self.progress.elapsed()
        self.state, statistics, metrics, taken = self.population.advance(self._compiled, self.state, mode, pause)
        ended = self._clock.submit(lambda: (jax.block_until_ready(statistics), self.progress.elapsed())[1])
        self._reached += taken * self._schedule.num_envs
        return Chunk(taken, self._reached, began, ended, statistics, metrics)

    @property
    def total(self) -> int:
        """Steps that each environment takes in the whole training."""
        return math.ceil(self.progress.total / self._schedule.num_envs)

    @property
    def environments(self) -> int:
        """Environments of all members."""
        return self._schedule.num_envs * self.population.members

    def seconds_left(self) -> float | None:
        """Time [s] that is left of a run by the clock, None of one by steps."""
        return None if self._ends is None else max(self._ends - time.monotonic(), 0.0)

    def end_at(self, total: int) -> None:
        """Plan a training of `total` steps of each environment."""
        self.progress.total = total * self._schedule.num_envs
        self.state = self.population.ending_at(self.state, self.progress.total)

    def saved_long_ago(self) -> bool:
        """Whether the last checkpoint is older than `SAVE_EVERY`."""
        return self.progress.elapsed() - self._saved_at > SAVE_EVERY

    def row(self, chunk: Chunk) -> Row:
        """The row of metrics.csv for a chunk, after waiting for the devices. Raises TrainingDivergedError."""
        statistics, metrics = processes.gather((chunk.statistics, chunk.metrics))
        ended = chunk.ended.result()
        began, self._chunk_ended = max(chunk.began, self._chunk_ended), ended
        each, members, steps = self.population.each, self.population.members, chunk.steps
        learnt = {name: _median(each(value)) for name, value in metrics.items()}
        broken = [name for name, value in learnt.items() if not math.isfinite(value)]
        if broken:
            raise TrainingDivergedError(f"{broken[0]} is not finite after {chunk.reached:,} steps")
        return {
            "steps": chunk.reached,
            "seconds": round(self.progress.before + ended, 3),
            "rate": round(steps * self._schedule.num_envs * members / max(ended - began, 1e-9), 1),
            "episode_return": _median(each(statistics.reward)) / steps * self.config.timing.episode_steps,
            **{
                name: _median_or_none(values)
                for name, values in self.population.report(statistics, steps, False).items()
            },
            **learnt,
            "terminated": int(each(statistics.ended).sum()),
            "diverged": int(each(statistics.totals["diverged"]).sum()) if "diverged" in statistics.totals else 0,
        }

    def evaluate(self) -> Row:
        """Evaluate the policies, always on the same initial states; the columns of metrics.csv, medians over members.

        Environments and keys of training are restored afterwards.
        """
        population, training = self.population, self.state
        steps = population.program.evaluation_steps
        keys = processes.gather(training.key)
        envs = population.evaluation_envs(self._compiled)
        evaluated = training._replace(envs=envs, key=population.place_keys(keys))
        after, statistics, *_ = population.advance(self._compiled, evaluated, programs.evaluate_mode(steps))
        statistics = processes.gather(statistics)
        self.state = after._replace(envs=training.envs, key=population.place_keys(keys))
        reward, ended = population.each(statistics.reward), population.each(statistics.ended)
        results = {"eval_return": population.program.evaluated_return(reward, ended)}
        results |= {f"eval_{name}": values for name, values in population.report(statistics, steps, True).items()}
        if population.members > 1:
            self.members.add(self._reached, results)
        return {name: _median_or_none(values) for name, values in results.items()}

    def save(self) -> None:
        """Write policy and checkpoint, if there were steps since the last; the checkpoint in a separate thread."""
        began = self.progress.elapsed()
        if self._state is None or self._saved_steps == self._reached:
            return
        self._saved_steps = self._reached
        exported = self._export()
        snapshot = self._snapshot()
        if exported and self._checkpoints:
            if self._pending:
                self._pending.result()
            self._pending = self._writer.submit(_write, self._checkpoints, snapshot)
        self._saved_at = self.progress.elapsed()
        self._saving += self._saved_at - began

    def _snapshot(self) -> TrainState:
        """A copy of the state to write, because the next chunk of training reuses its buffers.

        It stays on the device if that has room, and is copied to the host in the writing thread.
        """
        sizes = [leaf.nbytes / self.population.devices for leaf in jax.tree.leaves(self.state)]  # on each device
        stats = jax.local_devices()[0].memory_stats() or {}
        room = stats.get("bytes_limit", math.inf) - stats.get("bytes_in_use", 0)
        if jax.process_count() > 1 or 2 * sum(sizes) > room:
            return processes.gather(self.state)
        return jax.device_put(self.state, jax.tree.map(lambda leaf: leaf.sharding, self.state), may_alias=False)

    def _network_path(self, member: int) -> Path:
        return self.members.policy_path(member) if self.population.members > 1 else self.out / POLICY

    def _export(self) -> bool:
        """Write the policy file, in a population every member's and that of the best; False if none is finite."""
        steps, exported = self._reached, False
        best = self.members.best()
        state = processes.gather(self.state._replace(envs=()))
        if not self._writes:
            return False
        for member in range(self.population.members):
            learnt = self.population.policy(state, member)
            seed = self.origin["seed"] + member
            origin = {**self.origin, "seed": seed, **training_summary(self.out, seed)}
            if self._starts:
                origin["start_from"] = self._starts[member % len(self._starts)]
            config = self.population.member_config(member)
            if not is_transport_env(self.population.program.env):  # a policy file has the layout of our observation
                exported |= network_file(self._network_path(member), learnt, steps, origin)
                continue
            policy = policy_file(config, network_interface(config), learnt, steps, origin)
            if not is_sound(policy):
                continue
            exported = True
            if self.population.members > 1:
                save_file(self.members.policy_path(member), policy)
            if member == best:
                save_file(self.out / POLICY, policy)
        return exported


def _open_checkpoints(out: Path) -> Any:
    from mjxball.train.checkpoint import Checkpoints

    return Checkpoints(out)


def _write(checkpoints: Future[Any], state: TrainState) -> None:
    checkpoints.result().save(processes.gather(state))


def _keep_newest(written: Future[None], checkpoints: Future[Any] | None) -> None:
    written.result()
    if checkpoints:
        checkpoints.result().keep_newest()


def _count(state: TrainState) -> int:
    """Environment steps so far, the same for every member of a population."""
    return int(np.ravel(processes.gather(state.steps))[0])


def _median(values: np.ndarray) -> float:
    """Median over the members whose value is finite; NaN if none is."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else math.nan


def _median_or_none(values: np.ndarray) -> float | None:
    """`_median`, or None in place of NaN."""
    median = _median(values)
    return None if math.isnan(median) else median
