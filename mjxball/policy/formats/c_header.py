"""A policy as one C99 header without allocation, for an app on board. Needs NumPy alone."""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjxball import __version__
from mjxball.control.follower_law import NEAR_ERROR, NEAR_ERROR_RATE, FollowerLaw
from mjxball.control.followers import LARGEST
from mjxball.control.geometry import GEOMETRY_SIZE
from mjxball.control.observation import (
    ACTION_SIZE,
    ERROR,
    ERROR_RATE,
    OBSERVATION,
    OBSERVATION_SIZE,
)
from mjxball.errors import InputError
from mjxball.policy.file import PolicyFile, law_of
from mjxball.policy.formats import c_texts
from mjxball.policy.inference import known_geometry
from mjxball.policy.quantize import Rows, balanced, rows_of

FLOAT = 4  # bytes
WIDEST_INT8 = 512  # products of 8 and 16 bits whose sum fits into 32
APP = "mjxball"  # what the names in an app on board begin with, of which there is one a program


@dataclass(frozen=True)
class Footprint:
    """What a header costs on board [bytes]; code comes on top, about 1 KiB with -Os."""

    flash: int  # constants
    state: int  # `mjxball_follower`, where a pointer has 4 bytes
    stack: int  # arrays of one call


def footprint(policy: PolicyFile, int8: bool = False) -> Footprint:
    """Bytes that the header of `policy` needs, see `c_header`."""
    (weights, biases), law = layers_of(policy), law_of(policy.card)
    size, units = len(policy.observation_mean), law.units
    outputs = [weight.shape[1] for weight in weights]
    widest = max(outputs[2 if units else 0 :])
    constants = 2 * ACTION_SIZE + GEOMETRY_SIZE * law.geometry
    own = 11 * units + size if units else 0  # `given`, `kept`, `next`, `joined`, and behind both of `hidden`
    state, stack = FLOAT * law.size + 4, FLOAT * (size + 2 * widest + own)
    if int8:
        flash = len(weight_bytes(policy)) + FLOAT * constants
        return Footprint(flash, state + FLOAT, stack + 2 * (_most_inputs(weights) + 7))
    constants += sum(rows_up(weight.shape[1]) * weight.shape[0] for weight in weights)
    constants += sum(bias.size for bias in biases) + 2 * size
    return Footprint(FLOAT * constants, state, stack)


def _most_inputs(weights: Sequence[np.ndarray]) -> int:
    return max(weight.shape[0] for weight in weights)


def c_header(policy: PolicyFile, name: str, int8: bool = False, prefix: str | None = None) -> str:
    """The header's text. Its function `follow` computes what `mjxball.Policy` computes, in float.

    All names begin with `prefix`, `prefix_of(name)` by default, so that headers of several policies fit into one
    program; of two with the same names a compiler says so, since a header's guard is that of its contents. With `int8`
    the weights are whole numbers of 8 bits (`policy.quantize`) in one struct, for which another one of the same layout
    may be put in place at run time, `follower.weights`. A policy that is told its team is that of the one follower that
    `team` in its card names; InputError without it, and for layers too wide for `int8`.
    """
    geometry = known_geometry(policy.card, name)
    law, card, cost = law_of(policy.card), policy.card, footprint(policy, int8)
    history = law.history
    weights, _ = layers_of(policy)
    outputs = [weight.shape[1] for weight in weights[2 if law.units else 0 :]]
    size, most = len(policy.observation_mean), _most_inputs(weights)
    if int8 and most > WIDEST_INT8:
        raise InputError(f"{name} has a layer of {most} inputs; with weights of 8 bits {WIDEST_INT8} at most")
    arrays = _float_arrays(policy) if not int8 else []
    tilt, vertical = card["command_limits"]
    arrays += [_array("action_scale", policy.action_scale), _array("limit", [tilt, tilt, vertical])]
    arrays += [] if geometry is None else [_array("geometry", geometry)]
    helpers = c_texts.EXPONENTIAL + (c_texts.LAYER_INT8 if int8 else c_texts.LAYER)
    helpers += (c_texts.APPROACH if history.filters else "") + (c_texts.GRU if law.units else "")
    text = c_texts.HEADER.format(
        name=_plain(name),
        origin=_plain(f"preset {card['preset']}, configuration {card['config_hash']}, {card['training_steps']} steps"),
        trained=_plain(card["package_version"]),
        version=__version__,
        period=f"{card['control_period']:g}",
        gravity=_number(card["gravity"]),
        observation=_table(),
        layers=" x ".join(map(str, [size, *([f"GRU {law.units}"] if law.units else []), *outputs])),
        flash=cost.flash,
        state=cost.state,
        stack=cost.stack,
        size=size,
        widest=max(outputs) + law.units,
        most_inputs=most,
        largest=_number(LARGEST),
        int8="#define MJXBALL_INT8 1\n" if int8 else "",
        weights=", weights of 8 bits" if int8 else "",
        includes="#include <stdint.h>\n\n" if int8 else "",
        weights_field="    const mjxball_weights *weights;  /* 0: those compiled in */\n" if int8 else "",
        weights_type=_weights_type(policy) if int8 else "",
        compiled=_compiled(policy) if int8 else "",
        leader="\n".join(["    int i;", *_leader(card, "to")]),
        memory_size=law.size,
        memory_field=f"    mjxball_real memory[{law.size}];\n" if law.size else "",
        helpers=helpers,
        team="" if geometry is None else _team(card["team"]),
        mount_angle="" if geometry is None else f"#define MJXBALL_MOUNT_ANGLE {_number(card['team']['mount_angle'])}\n",
        memory_pointer="    mjxball_real *memory = follower->memory;\n" if law.size else "",
        arrays="\n".join(arrays),
        history=_history(law),
        history_update=_history_update(law),
        network=_network(law, policy, int8),
        command=_command(law),
    )
    return _named(text, prefix or prefix_of(name))


def prefix_of(name: str) -> str:
    """What the names in the header of a policy called `name` begin with; macros in upper case."""
    return f"{APP}_{re.sub('[^a-z0-9]', '_', name.lower())}"


def _named(text: str, prefix: str) -> str:
    """`text` with its own names; `MJXBALL_REAL` is its user's."""
    text = text.replace("MJXBALL_GUARD", f"MJXBALL_H_{zlib.crc32(text.encode()):08X}")
    text = re.sub(r"\bmjxball_", f"{prefix}_", text)
    return re.sub(r"\bMJXBALL_(?!REAL\b)", f"{prefix.upper()}_", text)


def _team(team: dict[str, Any]) -> str:
    """Lines of the comment on the frame of a follower of a team."""
    return (
        f" * It is drone {int(team['drone'])} of its team. Observation and command are in its mount frame: world and\n"
        " * body axes turned by MJXBALL_MOUNT_ANGLE [rad] about body z, so that its mount lies at negative x.\n"
    )


def layers_of(policy: PolicyFile) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weights and biases without the last layer's second half, which exploration alone uses.

    Before them those of a GRU: for what is seen, and for its state, whose bias is empty.
    """
    weights = [*policy.weights[:-1], policy.weights[-1][:, :ACTION_SIZE]]
    biases = [*policy.biases[:-1], policy.biases[-1][:ACTION_SIZE]]
    if policy.gru is None:
        return weights, biases
    kernel, recurrent, bias = policy.gru
    return [kernel, recurrent, *weights], [bias, bias[:0], *biases]


def _float_arrays(policy: PolicyFile) -> list[str]:
    arrays = [_array("mean", policy.observation_mean), _array("scale", policy.observation_scale)]
    for number, (weight, bias) in enumerate(zip(*layers_of(policy), strict=True)):
        arrays += [_array(f"weight_{number}", _side_by_side(weight))]
        arrays += [_array(f"bias_{number}", bias)] if bias.size else []
    return arrays


def _side_by_side(weight: np.ndarray) -> np.ndarray:
    """`weight` (inputs, outputs) as (blocks, inputs, 4), outputs filled up with zeros: four of them in a block."""
    inputs, outputs = weight.shape
    padded = np.pad(weight, ((0, 0), (0, rows_up(outputs) - outputs)))
    return padded.reshape(inputs, -1, 4).swapaxes(0, 1)


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


def _history(law: FollowerLaw) -> str:
    """Lines that make the network's input of observation and memory (see `control.follower_law.FollowerLaw`)."""
    history = law.history
    if not law.size:
        return "    (void)follower;"
    width = OBSERVATION_SIZE + ACTION_SIZE
    lines = ["    if (!follower->running) {"]
    lines += [f"        for (i = 0; i < {law.size}; i++) memory[i] = 0;"]
    for k in range(len(history.filters)):
        lines += [f"        mjxball_copy(memory + {k * width}, observation, {OBSERVATION_SIZE});"]
    if law.geometry:
        kept = f"memory[{history.size + law.units} + i]"
        lines += [f"        for (i = 0; i < {GEOMETRY_SIZE}; i++) {kept} = mjxball_geometry[i];"]
    lines += ["        follower->running = 1;", "    }"]
    lines += [f"    mjxball_copy(input + {OBSERVATION_SIZE}, memory, {history.size});"]
    for k in range(len(history.filters)):
        place = OBSERVATION_SIZE + k * width
        lines += [f"    for (i = 0; i < {OBSERVATION_SIZE}; i++) input[{place} + i] -= observation[i];"]
    if law.units:
        lines += _saturated(law, OBSERVATION_SIZE + history.size)
    return "\n".join(lines)


def _saturated(law: FollowerLaw, place: int) -> list[str]:
    """Lines that put what a recurrent network sees besides behind the first `place` numbers of `input`."""
    lines = []
    for part, scale in ((ERROR, NEAR_ERROR), (ERROR_RATE, NEAR_ERROR_RATE)):
        small = f"observation[{part.start} + i] * (mjxball_real){1 / scale!r}"
        lines += [f"    for (i = 0; i < 3; i++) input[{place} + i] = mjxball_tanh({small});"]
        place += 3
    if law.geometry:
        lines += [f"    mjxball_copy(input + {place}, memory + {law.history.size + law.units}, {GEOMETRY_SIZE});"]
    return lines


def _history_update(law: FollowerLaw) -> str:
    """Lines that move the memory on by one step."""
    lines, history, width = [], law.history, OBSERVATION_SIZE + ACTION_SIZE
    for k, tau in enumerate(history.filters):
        place, share = k * width, _number(-math.expm1(-history.period / tau))
        lines += [f"    mjxball_approach(memory + {place}, observation, {OBSERVATION_SIZE}, {share});"]
        lines += [f"    mjxball_approach(memory + {place + OBSERVATION_SIZE}, action, {ACTION_SIZE}, {share});"]
    if history.previous_action:
        lines += [f"    mjxball_copy(memory + {history.size - ACTION_SIZE}, action, {ACTION_SIZE});"]
    if law.units:
        lines += [f"    mjxball_copy(memory + {history.size}, next, {law.units});"]
    return "\n".join(lines)


def _network(law: FollowerLaw, policy: PolicyFile, int8: bool) -> str:
    """Lines that scale `input` and call the layers."""
    size, own = len(policy.observation_mean), "w->" if int8 else "mjxball_"
    weights, biases = layers_of(policy)
    shapes = [weight.shape for weight in weights]
    lines = (
        ["    const mjxball_weights *w = follower->weights ? follower->weights : &mjxball_compiled;"] if int8 else []
    )
    lines += [f"    for (i = 0; i < {size}; i++) input[i] = (input[i] - {own}mean[i]) * {own}scale[i];"]
    calls = []
    for n, ((inputs, outputs), bias) in enumerate(zip(shapes, biases, strict=True)):
        steps, row = (f"w->step_{n}, ", f", {stride(inputs)}") if int8 else ("", "")
        added = f"{own}bias_{n}" if bias.size else "0"
        calls += [f"mjxball_layer({own}weight_{n}, {steps}{added}, {inputs}, {outputs}{row}"]
    if not law.units:
        return "\n".join([*lines, *_layers(shapes, calls, "input")])
    units, state = law.units, f"memory + {law.history.size}"
    lines += [f"    mjxball_real given[{3 * units}], kept[{3 * units}], next[{units}], joined[{size + 2 * units}];"]
    lines += [_called(f"{calls[0]}, input, given)"), _called(f"{calls[1]}, {state}, kept)")]
    lines += [f"    mjxball_gru(given, kept, {state}, {units}, next);"]
    lines += [f"    mjxball_copy(joined, next, {units});", f"    mjxball_copy(joined + {units}, input, {size});"]
    return "\n".join([*lines, *_layers(shapes[2:], calls[2:], "joined", units)])


def _layers(shapes: Sequence[tuple[int, int]], calls: Sequence[str], source: str, units: int = 0) -> list[str]:
    """`calls` of the layers, from `source` through two buffers in turn to `action`.

    The last one also sees the `units` numbers of `next`.
    """
    lines, last = [], len(shapes) - 1
    for number, (call, (inputs, outputs)) in enumerate(zip(calls, shapes, strict=True)):
        target = "action" if number == last else f"hidden[{number % 2}]"
        if number == last and units:
            lines.append(f"    mjxball_copy({source} + {inputs - units}, next, {units});")
        lines.append(_called(f"{call}, {source}, {target})"))
        if number < last:
            lines.append(f"    for (i = 0; i < {outputs}; i++) if ({target}[i] < 0) {target}[i] = 0;")
        source = target
    return lines


def _called(layer: str) -> str:
    return f"    if (!{layer}) return mjxball_no_answer(follower, action, command);"


def stride(inputs: int) -> int:
    """Weights of 8 bits in a row, a multiple of 8."""
    return -(-inputs // 8) * 8


def rows_up(outputs: int) -> int:
    """Rows of weights, a multiple of 4."""
    return -(-outputs // 4) * 4


def _weights_type(policy: PolicyFile) -> str:
    """The struct whose bytes are `weight_bytes`."""
    floats, whole = [f"{kind}[{len(policy.observation_mean)}]" for kind in ("mean", "scale")], []
    for n, (weight, bias) in enumerate(zip(*layers_of(policy), strict=True)):
        inputs, outputs = weight.shape
        floats += [f"step_{n}[{outputs}]", *([f"bias_{n}[{outputs}]"] if bias.size else [])]
        whole += [f"weight_{n}[{rows_up(outputs) * stride(inputs)}]"]
    fields = [*(f"float {one}" for one in floats), *(f"int8_t {one}" for one in whole)]
    return "typedef struct {\n" + "".join(f"    {one};\n" for one in fields) + "} mjxball_weights;\n\n"


def _layers_int8(policy: PolicyFile) -> tuple[list[Rows], list[np.ndarray]]:
    weights, biases = layers_of(policy)
    return [rows_of(weight) for weight in weights], biases


def weight_bytes(policy: PolicyFile) -> bytes:
    """The struct `mjxball_weights` of `policy` as a little-endian machine holds it."""
    policy = balanced(policy)
    rows, biases = _layers_int8(policy)
    parts = [policy.observation_mean, policy.observation_scale]
    for own, bias in zip(rows, biases, strict=True):
        parts += [own.step, bias]
    floats = b"".join(np.asarray(part, "<f4").tobytes() for part in parts)
    return floats + b"".join(_padded(own.weight).tobytes() for own in rows)


def float_bytes(policy: PolicyFile) -> bytes:
    """What the network computes with, as a little-endian machine holds it."""
    weights, biases = layers_of(policy)
    parts = [*_scaling(policy), *(part for one in zip(weights, biases, strict=True) for part in one)]
    return b"".join(np.asarray(part, "<f4").tobytes() for part in parts)


def _padded(weight: np.ndarray) -> np.ndarray:
    """Rows of `weight` (outputs, inputs), both filled up with zeros."""
    outputs, inputs = weight.shape
    return np.pad(weight, ((0, rows_up(outputs) - outputs), (0, stride(inputs) - inputs)))


def _compiled(policy: PolicyFile) -> str:
    """The constant `mjxball_compiled`."""
    policy = balanced(policy)
    rows, biases = _layers_int8(policy)
    parts: list[list[str]] = [[_number(value) for value in part] for part in _scaling(policy)]
    for own, bias in zip(rows, biases, strict=True):
        parts += [[_number(value) for value in part] for part in (own.step, bias) if part.size]
    parts += [[str(value) for value in _padded(own.weight).ravel()] for own in rows]
    return "static const mjxball_weights mjxball_compiled = {\n" + ",\n".join(map(_braced, parts)) + "};\n"


def _scaling(policy: PolicyFile) -> tuple[np.ndarray, np.ndarray]:
    return policy.observation_mean, policy.observation_scale


def _braced(numbers: Sequence[str]) -> str:
    return "    {" + ",\n     ".join(", ".join(numbers[k : k + 16]) for k in range(0, len(numbers), 16)) + "}"


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


def _command(law: FollowerLaw) -> str:
    """Lines that make the command of `action`, which is added to the PD law unless it is direct."""
    base = "mjxball_copy_law(observation, command);"
    return "\n".join(
        [
            f"    {base if law.residual else 'for (i = 0; i < 3; i++) command[i] = 0;'}",
            "    for (i = 0; i < 3; i++)",
            "        command[i] = mjxball_clip(command[i] + mjxball_action_scale[i] * action[i], mjxball_limit[i]);",
        ]
    )
