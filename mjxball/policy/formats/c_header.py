"""A policy as one C99 header without allocation, for an app on board. Needs NumPy alone."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjxball.control.follower_law import FollowerLaw
from mjxball.control.observation import (
    ACTION_SIZE,
    ERROR,
    ERROR_RATE,
    OBSERVATION,
    OBSERVATION_SIZE,
)
from mjxball.policy.file import PolicyFile, law_of

FLOAT = 4  # bytes


@dataclass(frozen=True)
class Footprint:
    """What a header costs on board [bytes]; code comes on top, about 1 KiB with -Os."""

    flash: int  # constants
    state: int  # `mjxball_follower`
    stack: int  # arrays of one call


def footprint(policy: PolicyFile) -> Footprint:
    """Bytes that the header of `policy` needs."""
    weights, biases = _mean_layers(policy)
    size = len(policy.observation_mean)
    widest = max(len(bias) for bias in biases)
    lqg = law_of(policy.card).lqg
    constants = sum(array.size for array in (*weights, *biases)) + 2 * size + 2 * ACTION_SIZE
    constants += 0 if lqg is None else sum(np.size(value) for value in lqg)
    return Footprint(FLOAT * constants, FLOAT * (size - OBSERVATION_SIZE) + 4, FLOAT * (size + 2 * widest))


def c_header(policy: PolicyFile, name: str) -> str:
    """The header's text. `mjxball_follow` computes what `mjxball.Policy` computes, in float."""
    law, card, cost = law_of(policy.card), policy.card, footprint(policy)
    history = law.history
    weights, biases = _mean_layers(policy)
    sizes = [len(policy.observation_mean), *map(len, biases)]
    arrays = [_array("mean", policy.observation_mean), _array("scale", policy.observation_scale)]
    for number, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        arrays += [_array(f"weight_{number}", weight.T), _array(f"bias_{number}", bias)]
    tilt, vertical = card["command_limits"]
    arrays += [_array("action_scale", policy.action_scale), _array("limit", [tilt, tilt, vertical])]
    if law.lqg is not None:
        arrays += [
            _array("lqg_tilts" if name == "tilt" else f"lqg_{name}", np.atleast_1d(value))
            for name, value in law.lqg._asdict().items()
        ]
    return HEADER.format(
        name=_plain(name),
        origin=_plain(f"preset {card['preset']}, configuration {card['config_hash']}, {card['training_steps']} steps"),
        version=_plain(card["package_version"]),
        period=f"{card['control_period']:g}",
        gravity=_number(card["gravity"]),
        observation=_table(),
        layers=" x ".join(map(str, sizes)),
        flash=cost.flash,
        state=cost.state,
        stack=cost.stack,
        size=sizes[0],
        widest=max(sizes[1:]),
        memory_size=law.size,
        memory_field=f"    mjxball_real memory[{law.size}];\n" if law.size else "",
        helpers=(APPROACH if history.filters else "") + (LQG if law.lqg is not None else ""),
        memory_pointer="    mjxball_real *memory = follower->memory;\n" if law.size else "",
        arrays="\n".join(arrays),
        history=_history(law, card),
        history_update=_history_update(law),
        network=_network(sizes),
        command=_command(law, card),
    )


def _mean_layers(policy: PolicyFile) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weights and biases without the last layer's second half, which exploration alone uses."""
    weights = [*policy.weights[:-1], policy.weights[-1][:, :ACTION_SIZE]]
    return weights, [*policy.biases[:-1], policy.biases[-1][:ACTION_SIZE]]


def _number(value: float | np.floating) -> str:
    """The shortest literal that is exactly this float."""
    return np.format_float_scientific(np.float32(value), unique=True, trim="0") + "f"


def _array(label: str, values: Iterable[Any]) -> str:
    numbers = [_number(value) for value in np.asarray(values, np.float32).ravel()]
    rows = [", ".join(numbers[k : k + 8]) for k in range(0, len(numbers), 8)]
    body = ",\n    ".join(rows)
    return f"static const float mjxball_{label}[{len(numbers)}] = {{\n    {body}}};"


def _plain(text: Any) -> str:
    """`text` fit for a C comment, whatever a policy's card says."""
    return re.sub(r"[^A-Za-z0-9 ,.;:_+()-]", "?", str(text))[:200]


def _table() -> str:
    return "\n".join(f" *   {slot:2d}  {name:<22}{unit}" for slot, (name, unit) in enumerate(OBSERVATION))


def _history(law: FollowerLaw, card: dict[str, Any]) -> str:
    """Lines that make the network's input of observation and memory (see `control.follower_law.FollowerLaw`)."""
    history = law.history
    if not law.size:
        return "    (void)follower;"
    older, width = (history.length - 1) * OBSERVATION_SIZE, OBSERVATION_SIZE + ACTION_SIZE
    lines = ["    if (!follower->running) {"]
    lines += [f"        for (i = 0; i < {law.size}; i++) memory[i] = 0;"]
    for k in range(history.length - 1):
        lines += [f"        mjxball_copy(memory + {k * OBSERVATION_SIZE}, observation, {OBSERVATION_SIZE});"]
    for k in range(len(history.filters)):
        lines += [f"        mjxball_copy(memory + {older + k * width}, observation, {OBSERVATION_SIZE});"]
    if law.lqg is not None:
        lines += [f"        mjxball_lqg_start(memory + {history.size}, observation);"]
    lines += ["        follower->running = 1;", "    }"]
    lines += [f"    mjxball_copy(input + {OBSERVATION_SIZE}, memory, {law.size});"]
    for k in range(len(history.filters)):
        place = OBSERVATION_SIZE + older + k * width
        lines += [f"    for (i = 0; i < {OBSERVATION_SIZE}; i++) input[{place} + i] -= observation[i];"]
    if law.lqg is not None:
        lines = ["    mjxball_real led[3];", *_leader(card, "led"), *lines]
        lines += [f"    mjxball_lqg_estimate(memory + {history.size}, observation);"]
        features = f"input + {OBSERVATION_SIZE + history.size}"
        lines += [f"    mjxball_lqg_features(memory + {history.size}, observation, {features});"]
    return "\n".join(lines)


def _history_update(law: FollowerLaw) -> str:
    """Lines that move the memory on by one step."""
    lines, history = [], law.history
    older, width = (history.length - 1) * OBSERVATION_SIZE, OBSERVATION_SIZE + ACTION_SIZE
    if older:
        lines += [
            f"    for (i = {older - 1}; i >= {OBSERVATION_SIZE}; i--) memory[i] = memory[i - {OBSERVATION_SIZE}];"
        ]
        lines += [f"    mjxball_copy(memory, observation, {OBSERVATION_SIZE});"]
    for k, tau in enumerate(history.filters):
        place, share = older + k * width, _number(-math.expm1(-history.period / tau))
        lines += [f"    mjxball_approach(memory + {place}, observation, {OBSERVATION_SIZE}, {share});"]
        lines += [f"    mjxball_approach(memory + {place + OBSERVATION_SIZE}, action, {ACTION_SIZE}, {share});"]
    if history.previous_action:
        lines += [f"    mjxball_copy(memory + {history.size - ACTION_SIZE}, action, {ACTION_SIZE});"]
    if law.lqg is not None:
        lines += [f"    mjxball_lqg_next(memory + {history.size}, observation, led, command);"]
    return "\n".join(lines)


def _network(sizes: Sequence[int]) -> str:
    """Calls of the layers, from `input` through two buffers in turn to `action`."""
    lines, source = [], "input"
    last = len(sizes) - 2
    for number in range(last + 1):
        target = "action" if number == last else f"hidden[{number % 2}]"
        arrays = f"mjxball_weight_{number}, mjxball_bias_{number}"
        lines.append(f"    mjxball_layer({arrays}, {sizes[number]}, {sizes[number + 1]}, {source}, {target});")
        if number < last:
            lines.append(f"    for (i = 0; i < {sizes[number + 1]}; i++) if ({target}[i] < 0) {target}[i] = 0;")
        source = target
    return "\n".join(lines)


def _leader(card: dict[str, Any], to: str) -> list[str]:
    """Lines that make the leader's PD law on the observed error, within the limits, in the array `to`."""
    g = _number(card["gravity"])
    wanted = [
        f"{_number(kp)} * observation[{ERROR.start + k}] + {_number(kd)} * observation[{ERROR_RATE.start + k}]"
        for k, (kp, kd) in enumerate(zip(card["leader_kp"], card["leader_kd"], strict=True))
    ]
    return [
        f"    {to}[0] = -({wanted[1]}) / {g};",
        f"    {to}[1] = ({wanted[0]}) / {g};",
        f"    {to}[2] = {wanted[2]};",
        f"    for (i = 0; i < 3; i++) {to}[i] = mjxball_clip({to}[i], mjxball_limit[i]);",
    ]


def _command(law: FollowerLaw, card: dict[str, Any]) -> str:
    """Lines that make the command of `action`, which is added to a law unless it is direct."""
    added = "mjxball_action_scale[i] * action[i]"
    if law.lqg is not None:
        lines = [f"    for (i = 0; i < 3; i++) command[i] = {added};"]
        lines += [f"    mjxball_lqg_command(memory + {law.history.size}, observation, led, command);"]
        return "\n".join(
            [*lines, "    for (i = 0; i < 3; i++) command[i] = mjxball_clip(command[i], mjxball_limit[i]);"]
        )
    lines = _leader(card, "command") if law.residual else ["    for (i = 0; i < 3; i++) command[i] = 0;"]
    lines += [
        "    for (i = 0; i < 3; i++)",
        f"        command[i] = mjxball_clip(command[i] + {added}, mjxball_limit[i]);",
    ]
    return "\n".join(lines)


HEADER = """\
/* Follower {name}, exported by mjxball {version}: {origin}.
 *
 *   mjxball_follower follower;
 *   mjxball_reset(&follower);                                   before every flight
 *   mjxball_follow(&follower, observation, action, command);    every {period} s
 *
 * observation (18), SI units and radians, world axes, body rates in body axes:
{observation}
 * action (3): the network's mean in [-1, 1]. command (3): roll [rad], pitch [rad], vertical acceleration [m/s2].
 *
 * Network {layers}, ReLU, tanh. C99, needs math.h; no allocation, no globals but constants.
 * Flash: {flash} bytes of constants, and the code. RAM: {state} bytes for mjxball_follower,
 * {stack} bytes of arrays on the stack during mjxball_follow.
 * Define MJXBALL_REAL as double before including this for arithmetic without rounding to float, at twice the RAM.
 */
#ifndef MJXBALL_FOLLOWER_H
#define MJXBALL_FOLLOWER_H

#include <math.h>

#ifndef MJXBALL_REAL
#define MJXBALL_REAL float
#endif
typedef MJXBALL_REAL mjxball_real;

#define MJXBALL_OBSERVATION_SIZE 18
#define MJXBALL_ACTION_SIZE 3
#define MJXBALL_MEMORY_SIZE {memory_size}
#define MJXBALL_CONTROL_PERIOD {period}
#define MJXBALL_GRAVITY {gravity}

typedef struct {{
{memory_field}    int running;
}} mjxball_follower;

{arrays}

static inline void mjxball_copy(mjxball_real *to, const mjxball_real *from, int count) {{
    for (int i = 0; i < count; i++) to[i] = from[i];
}}
static inline mjxball_real mjxball_clip(mjxball_real value, mjxball_real limit) {{
    return value < -limit ? -limit : value > limit ? limit : value;
}}
{helpers}
/* to = weight from + bias. Four sums side by side keep a pipelined FPU busy and round less than one long sum. */
static inline void mjxball_layer(
    const float *weight, const float *bias, int inputs, int outputs, const mjxball_real *from, mjxball_real *to) {{
    for (int row = 0; row < outputs; row++, weight += inputs) {{
        mjxball_real sum[4] = {{0, 0, 0, 0}};
        int k = 0;
        for (; k + 4 <= inputs; k += 4)
            for (int lane = 0; lane < 4; lane++) sum[lane] += weight[k + lane] * from[k + lane];
        for (; k < inputs; k++) sum[0] += weight[k] * from[k];
        to[row] = (sum[0] + sum[1]) + (sum[2] + sum[3]) + bias[row];
    }}
}}

/* Forget the past: the next call starts a flight. */
static inline void mjxball_reset(mjxball_follower *follower) {{
    follower->running = 0;
}}

static inline void mjxball_follow(
    mjxball_follower *follower, const mjxball_real observation[18], mjxball_real action[3], mjxball_real command[3]) {{
    mjxball_real input[{size}], hidden[2][{widest}];
{memory_pointer}    int i;
    mjxball_copy(input, observation, 18);
{history}
    for (i = 0; i < {size}; i++) input[i] = (input[i] - mjxball_mean[i]) * mjxball_scale[i];
{network}
    for (i = 0; i < 3; i++) action[i] = (mjxball_real)tanh((double)action[i]);
{command}
{history_update}
}}

#endif
"""
APPROACH = """
static inline void mjxball_approach(mjxball_real *average, const mjxball_real *value, int count, float share) {
    for (int i = 0; i < count; i++) average[i] += share * (value[i] - average[i]);
}
"""
LQG = """
/* LQG with estimates of the load; its memory: the filter's state (8) and what drives it (2). */
static inline void mjxball_lqg_start(mjxball_real *memory, const mjxball_real *observation) {
    memory[0] = observation[4];
    memory[1] = observation[10];
    memory[5] = -observation[17];
}

static inline void mjxball_lqg_estimate(mjxball_real *memory, const mjxball_real *observation) {
    mjxball_real predicted[8], off[3];
    for (int row = 0; row < 8; row++) {
        predicted[row] = 0;
        for (int k = 0; k < 10; k++) predicted[row] += mjxball_lqg_transition[10 * row + k] * memory[k];
    }
    off[0] = observation[4] - predicted[0];
    off[1] = observation[10] - predicted[1];
    off[2] = -observation[17] - predicted[5];
    for (int row = 0; row < 8; row++) {
        memory[row] = predicted[row];
        for (int k = 0; k < 3; k++) memory[row] += mjxball_lqg_gain[3 * row + k] * off[k];
    }
}

static inline void mjxball_lqg_features(const mjxball_real *memory, const mjxball_real *observation, mjxball_real *to) {
    to[0] = observation[4] - memory[0];
    to[1] = observation[10] - memory[1];
    to[2] = -observation[17] - memory[5];
    mjxball_copy(to + 3, memory + 2, 3);
    mjxball_copy(to + 6, memory + 6, 4);
}

static inline mjxball_real mjxball_lqg_tilt(int axis, int along, const mjxball_real *observation) {
    const float *gain = mjxball_lqg_tilts + 4 * axis;
    mjxball_real far = gain[0] * observation[12 + along] + gain[1] * observation[15 + along];
    return mjxball_clip(far, mjxball_lqg_limits[0]) - gain[2] * observation[3 + axis] - gain[3] * observation[9 + axis];
}

static inline mjxball_real mjxball_lqg_difference(
    mjxball_real led, mjxball_real vertical, const mjxball_real *observation) {
    mjxball_real level = (mjxball_real)(cos((double)observation[3]) * cos((double)observation[4]));
    mjxball_real ahead = mjxball_lqg_carried[0] * (MJXBALL_GRAVITY + led);
    return (ahead - mjxball_lqg_carried[1] * (MJXBALL_GRAVITY + vertical)) / level;
}

/* command: what is added to the law's, then the sum, of which the vertical part is within its limit. */
static inline void mjxball_lqg_command(
    const mjxball_real *memory, const mjxball_real *observation, const mjxball_real *led, mjxball_real *command) {
    mjxball_real rise = mjxball_lqg_height[0] * observation[14] + mjxball_lqg_height[1] * observation[17], against;
    rise = mjxball_clip(rise, mjxball_lqg_limits[1]) - memory[7];
    command[2] = mjxball_clip(2 * rise - led[2] + command[2], mjxball_limit[2]);
    against = mjxball_lqg_half_length[0] * mjxball_lqg_difference(led[2], command[2], observation) - memory[2];
    against = mjxball_clip(against / mjxball_lqg_stiffness[0], mjxball_lqg_limits[2]);
    command[0] += 2 * mjxball_lqg_tilt(0, 1, observation) - led[0];
    command[1] += 2 * mjxball_lqg_tilt(1, 0, observation) - led[1] + against;
}

static inline void mjxball_lqg_next(
    mjxball_real *memory, const mjxball_real *observation, const mjxball_real *led, const mjxball_real *command) {
    memory[8] = mjxball_lqg_stiffness[0] * (led[1] + command[1])
        - mjxball_lqg_half_length[0] * mjxball_lqg_difference(led[2], command[2], observation);
    memory[9] = (mjxball_real)0.5 * (led[2] + command[2]);
}
"""
