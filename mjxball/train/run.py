"""A training run on the host: run directory, chunks of compiled work, evaluations, checkpoints, Ctrl-C."""

from __future__ import annotations

import contextlib
import math
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mjxball.config import Config
from mjxball.export import is_sound, policy_file
from mjxball.policy import save_file
from mjxball.train import program as programs
from mjxball.train.checkpoint import Checkpoints, write_config
from mjxball.train.program import Program, Tally, TrainState
from mjxball.train.progress import Progress, Row

CHUNKS = 50  # rows of metrics.csv in a run
EVALUATIONS = 5
EVALUATION_SECONDS = 16.0  # of which the last half counts as steady state
POLICY = "policy.npz"
METRICS = "metrics.csv"


class TrainingDivergedError(RuntimeError):
    """A loss or a weight is not finite any more."""


@dataclass
class Stop:
    """Set by the first Ctrl-C; training then ends after the chunk in flight."""

    requested: bool = False


@contextlib.contextmanager
def graceful_interrupt(progress: Progress) -> Iterator[Stop]:
    """Turn the first Ctrl-C into a request to stop; a second one interrupts at once."""
    stop = Stop()
    default = signal.getsignal(signal.SIGINT)

    def handler(number: int, frame: Any) -> None:
        stop.requested = True
        signal.signal(signal.SIGINT, default)
        progress.say("stopping: saving the policy and a checkpoint (Ctrl-C again to quit at once)")

    signal.signal(signal.SIGINT, handler)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, default)


class Run:
    """One follower being trained into a run directory. `train()` returns False if it was interrupted."""

    def __init__(
        self, config: Config, seed: int, physics: str, out: Path, origin: dict[str, Any], resumed: TrainState | None
    ):
        self.config, self.seed, self.out, self.origin = config, seed, out, origin
        self.program = Program(config, physics)
        self._resumed = resumed
        out.mkdir(parents=True, exist_ok=True)
        if resumed is None:
            write_config(out, config, origin)
        self.progress = Progress(out / METRICS, config.sac.steps, int(resumed.steps) if resumed else 0)
        self.checkpoints = Checkpoints(out)
        self.state: TrainState | None = resumed

    def train(self) -> bool:
        """Train to the end or to Ctrl-C. Raises TrainingDivergedError; the last good policy stays on disk."""
        with contextlib.closing(self.checkpoints), contextlib.closing(self.progress):
            with graceful_interrupt(self.progress) as stop:
                try:
                    self._start()
                    self._loop(stop)
                except KeyboardInterrupt:
                    stop.requested = True
                self._save()
            return not stop.requested

    def _start(self) -> None:
        self.progress.say(f"compiling the training program for {jax.devices()[0].device_kind} ...")
        if self.state is None:
            self.state = jax.jit(self.program.create)(jax.random.PRNGKey(self.seed))
            self._export()
        advance = jax.jit(self.program.advance, donate_argnums=0)
        self._advance = advance.lower(self.state, programs.prefill(1)).compile()
        self._fresh = jax.jit(self.program.fresh_worlds)
        self.progress.say(f"compiled in {self.progress.elapsed():.1f} s")

    def _loop(self, stop: Stop) -> None:
        sac = self.config.sac
        total = math.ceil(sac.steps / sac.worlds)
        # At least one batch and one n-step window must be recorded before the first update.
        first = max(math.ceil(sac.prefill / sac.worlds), math.ceil(sac.batch / sac.worlds), sac.return_steps)
        done = int(self.state.steps) // sac.worlds
        if done < first and not stop.requested:
            self.state, _ = self._advance(self.state, programs.prefill(first - done))
            done = first
        chunk = max(1, math.ceil(total / CHUNKS))
        every = max(1, CHUNKS // EVALUATIONS)
        while done < total and not stop.requested:
            number = done // chunk + 1
            steps = min(number * chunk, total) - done
            row = self._chunk(steps)
            done += steps
            if number % every == 0 or done >= total:
                row = self._evaluated(row)
                self._save()
            self.progress.show(row)

    def _chunk(self, steps: int) -> Row:
        before = self.progress.elapsed()
        self.state, tally = self._advance(self.state, programs.train(steps, self.config.sac.updates))
        self.state = jax.block_until_ready(self.state)
        after = self.progress.elapsed()
        row = self._row(tally, steps, after, steps * self.config.sac.worlds / max(after - before, 1e-9))
        if not all(map(math.isfinite, (row.critic_loss, row.policy_loss, row.alpha))):
            raise TrainingDivergedError(f"a loss is not finite after {row.steps:,} steps")
        return row

    def _row(self, tally: Tally, steps: int, seconds: float, rate: float) -> Row:
        episode = self.config.timing.episode_steps
        return Row(
            steps=int(self.state.steps),
            seconds=round(seconds, 3),
            rate=round(rate, 1),
            episode_return=float(tally.reward) / steps * episode,
            steady_error=_mean(tally.steady_error, tally.steady),
            alpha=float(jnp.exp(self.state.learner.log_alpha)),
            entropy=float(tally.losses.entropy),
            critic_loss=float(tally.losses.critic),
            policy_loss=float(tally.losses.policy),
            terminated=int(tally.ended),
            diverged=int(tally.diverged),
        )

    def _evaluated(self, row: Row) -> Row:
        """Add the evaluation of the averaged policy, on the same fresh worlds every time."""
        steps = min(round(EVALUATION_SECONDS / self.config.timing.control_period), self.config.timing.episode_steps)
        kept = self.state
        worlds = self._fresh(jax.random.PRNGKey(0))
        # Donation hands the buffers over: worlds and key are copied so that training goes on from them unchanged.
        kept_worlds, kept_key = jax.tree.map(jnp.copy, (kept.worlds, kept.key))
        after, tally = self._advance(kept._replace(worlds=worlds), programs.evaluate(steps))
        self.state = after._replace(worlds=kept_worlds, key=kept_key)
        return Row(
            **{
                **row.__dict__,
                "eval_return": float(tally.reward) / steps * self.config.timing.episode_steps,
                "eval_steady_error": _mean(tally.steady_error, tally.steady),
                "eval_peak": float(tally.peak.mean()) if float(tally.steady) else None,
            }
        )

    def _save(self) -> None:
        if self.state is not None and self._export():
            self.checkpoints.save(self.state)

    def _export(self) -> bool:
        """Write the policy file, unless a value is not finite."""
        policy = policy_file(self.config, self.state.learner, int(self.state.steps), self.origin)
        if not is_sound(policy):
            return False
        save_file(self.out / POLICY, policy)
        return True


def _mean(total: jnp.ndarray, count: jnp.ndarray) -> float | None:
    """`total` / `count`, None if there was nothing to count."""
    return float(total) / float(count) if float(count) else None
