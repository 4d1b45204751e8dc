"""Export of a policy as one C99 header without allocation, for an app on board. Needs NumPy only."""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjxball import __version__
from mjxball.control.followers import MAX_OBSERVATION
from mjxball.control.geometry import GEOMETRY_SIZE
from mjxball.control.network_interface import NEAR_ERROR, NEAR_ERROR_RATE, NetworkInterface
from mjxball.control.observation import (
    ACTION_SIZE,
    ERROR,
    ERROR_RATE,
    OBSERVATION,
    OBSERVATION_SIZE,
    OWN_STATE,
    STALE,
)
from mjxball.errors import InputError
from mjxball.policy.file import PolicyFile, interface_of
from mjxball.policy.formats import c_texts
from mjxball.policy.inference import known_geometry
from mjxball.policy.quantize import Rows, balanced, rows_of

FLOAT = 4  # bytes
WIDEST_INT8 = 512  # largest number of 8-bit by 16-bit products whose sum fits into 32 bits
APP = "mjxball"  # prefix of names in an app on board, of which a program has one


@dataclass(frozen=True)
class Footprint:
    """Memory of a header on board [bytes], without code, which takes about 1 KiB with -Os."""

    flash: int  # constants
    state: int  # `mjxball_follower`, where a pointer has 4 bytes
    stack: int  # arrays of one call


def footprint(policy: PolicyFile, int8: bool = False) -> Footprint:
    """Memory that the header of `policy` needs on board, see `c_header`."""
    (weights, biases), interface = layers_of(policy), interface_of(policy.metadata)
    size, units = len(policy.observation_mean), interface.units
    outputs = [weight.shape[1] for weight in weights]
    widest = max(outputs[2 if units else 0 :])
    constants = 2 * ACTION_SIZE + GEOMETRY_SIZE * interface.geometry
    recurrent = 11 * units + size if units else 0  # `given`, `kept`, `next`, `joined`, and the ends of both `hidden`
    state, stack = FLOAT * interface.size + 4, FLOAT * (size + 2 * widest + recurrent)
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

    All names begin with `prefix`, by default `prefix_of(name)`, so that headers of several policies fit into one
    program. If two have the same prefix, the compiler reports it, because the include guard is a hash of the contents.

    With `int8` the weights are 8-bit integers (`policy.quantize`) in one struct, which can be exchanged at run time for
    another one of the same layout (`follower.weights`). A policy that takes its team's geometry is exported for the
    follower in its metadata field `team`. InputError without that field, or for layers too wide for `int8`.
    """
    geometry = known_geometry(policy.metadata, name)
    interface, metadata, cost = interface_of(policy.metadata), policy.metadata, footprint(policy, int8)
    history = interface.history
    weights, _ = layers_of(policy)
    outputs = [weight.shape[1] for weight in weights[2 if interface.units else 0 :]]
    size, most = len(policy.observation_mean), _most_inputs(weights)
    if int8 and most > WIDEST_INT8:
        raise InputError(f"{name} has a layer of {most} inputs; with weights of 8 bits {WIDEST_INT8} at most")
    arrays = _float_arrays(policy) if not int8 else []
    tilt, vertical = metadata["command_limits"]
    arrays += [_array("action_scale", policy.action_scale), _array("limit", [tilt, tilt, vertical])]
    arrays += [] if geometry is None else [_array("geometry", geometry)]
    helpers = c_texts.EXPONENTIAL + (c_texts.LAYER_INT8 if int8 else c_texts.LAYER)
    helpers += (c_texts.APPROACH if history.filters else "") + (c_texts.ARE_SAME if history.stale else "")
    helpers += c_texts.GRU if interface.units else ""
    text = c_texts.HEADER.format(
        name=_plain(name),
        origin=_plain(
            f"preset {metadata['preset']}, configuration {metadata['config_hash']}, {metadata['training_steps']} steps"
        ),
        trained=_plain(metadata["package_version"]),
        version=__version__,
        period=f"{metadata['control_period']:g}",
        gravity=_literal(metadata["gravity"]),
        observation=_table(),
        layers=" x ".join(map(str, [size, *([f"GRU {interface.units}"] if interface.units else []), *outputs])),
        flash=cost.flash,
        state=cost.state,
        stack=cost.stack,
        size=size,
        widest=max(outputs) + interface.units,
        most_inputs=most,
        largest=_literal(MAX_OBSERVATION),
        int8="#define MJXBALL_INT8 1\n" if int8 else "",
        weights=", weights of 8 bits" if int8 else "",
        includes="#include <stdint.h>\n\n" if int8 else "",
        weights_field="    const mjxball_weights *weights;  /* 0: those compiled in */\n" if int8 else "",
        weights_type=_weights_type(policy) if int8 else "",
        compiled=_compiled(policy) if int8 else "",
        leader="\n".join(["    int i;", *_leader(metadata, "to")]),
        memory_size=interface.size,
        memory_field=f"    mjxball_real memory[{interface.size}];\n" if interface.size else "",
        helpers=helpers,
        team="" if geometry is None else _team(metadata["team"]),
        mount_angle=""
        if geometry is None
        else f"#define MJXBALL_MOUNT_ANGLE {_literal(metadata['team']['mount_angle'])}\n",
        memory_pointer="    mjxball_real *memory = follower->memory;\n" if interface.size else "",
        arrays="\n".join(arrays),
        history=_history(interface),
        history_update=_history_update(interface),
        network=_network(interface, policy, int8),
        command=_command(interface),
    )
    return _named(text, prefix or prefix_of(name))


def prefix_of(name: str) -> str:
    """Prefix of all names in the header of the policy `name`; macros have it in upper case."""
    return f"{APP}_{re.sub('[^a-z0-9]', '_', name.lower())}"


def _named(text: str, prefix: str) -> str:
    """`text` with the names' prefix and the include guard replaced, but not `MJXBALL_REAL`, which the user sets."""
    text = text.replace("MJXBALL_GUARD", f"MJXBALL_H_{zlib.crc32(text.encode()):08X}")
    text = re.sub(r"\bmjxball_", f"{prefix}_", text)
    return re.sub(r"\bMJXBALL_(?!REAL\b)", f"{prefix.upper()}_", text)


def _team(team: dict[str, Any]) -> str:
    """Lines of the header's comment on the frame of a team's follower."""
    return (
        f" * It is drone {int(team['drone'])} of its team. Observation and command are in its mount frame: world and\n"
        " * body axes turned by MJXBALL_MOUNT_ANGLE [rad] about body z, so that its mount lies at negative x.\n"
    )


def layers_of(policy: PolicyFile) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """(weights, biases) of all layers, without the outputs of the last one that only exploration uses.

    A GRU comes first, as two layers: of its inputs, and of its state, with an empty bias.
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
    """`weight` (inputs, outputs) as (blocks, inputs, 4): blocks of four outputs, padded with zero outputs."""
    inputs, outputs = weight.shape
    padded = np.pad(weight, ((0, 0), (0, rows_up(outputs) - outputs)))
    return padded.reshape(inputs, -1, 4).swapaxes(0, 1)


def _literal(value: float | np.floating) -> str:
    """The shortest C literal that is exactly this float."""
    return np.format_float_scientific(np.float32(value), unique=True, trim="0") + "f"


def _array(label: str, values: Iterable[Any]) -> str:
    literals = [_literal(value) for value in np.asarray(values, np.float32).ravel()]
    rows = [", ".join(literals[k : k + 8]) for k in range(0, len(literals), 8)]
    body = ",\n    ".join(rows)
    return f"static const float mjxball_{label}[{len(literals)}] = {{\n    {body}}};"


def _plain(text: Any) -> str:
    """`text` with everything replaced that could end a C comment: it comes from a policy file."""
    return re.sub(r"[^A-Za-z0-9 ,.;:_+()-]", "?", str(text))[:200]


def _table() -> str:
    return "\n".join(f" *   {slot:2d}  {name:<22}{unit}" for slot, (name, unit) in enumerate(OBSERVATION))


def _history(interface: NetworkInterface) -> str:
    """C lines that compute the network's input from observation and memory (`NetworkInterface`)."""
    history = interface.history
    if not interface.size:
        return "    (void)follower;"
    width = OBSERVATION_SIZE + ACTION_SIZE
    lines = ["    if (!follower->running) {"]
    lines += [f"        for (i = 0; i < {interface.size}; i++) memory[i] = 0;"]
    for k in range(len(history.filters)):
        lines += [f"        mjxball_copy(memory + {k * width}, observation, {OBSERVATION_SIZE});"]
    if history.stale:  # as `ObservationHistory.start`
        lines += [f"        for (i = 0; i < {OWN_STATE}; i++) memory[{history.past_size} + i] = observation[i] + 1;"]
    if interface.geometry:
        stored = f"memory[{history.size + interface.units} + i]"
        lines += [f"        for (i = 0; i < {GEOMETRY_SIZE}; i++) {stored} = mjxball_geometry[i];"]
    lines += ["        follower->running = 1;", "    }"]
    lines += [f"    mjxball_copy(input + {OBSERVATION_SIZE}, memory, {history.past_size});"]
    for k in range(len(history.filters)):
        offset = OBSERVATION_SIZE + k * width
        lines += [f"    for (i = 0; i < {OBSERVATION_SIZE}; i++) input[{offset} + i] -= observation[i];"]
    if history.stale:
        last = f"memory + {history.past_size}"
        lines += [f"    if (!mjxball_are_finite({last}, {OWN_STATE}))"]
        lines += ["        return mjxball_no_answer(follower, action, command);"]
        flag = f"mjxball_are_same(observation, {last}, {OWN_STATE}) ? (mjxball_real){STALE!r} : 0"
        lines += [f"    input[{OBSERVATION_SIZE + history.past_size}] = {flag};"]
    if interface.units:
        lines += _saturated(interface, OBSERVATION_SIZE + history.input_size)
    return "\n".join(lines)


def _saturated(interface: NetworkInterface, offset: int) -> list[str]:
    """C lines that compute the additional inputs of a recurrent network, from index `offset` of `input` on."""
    lines = []
    for part, scale in ((ERROR, NEAR_ERROR), (ERROR_RATE, NEAR_ERROR_RATE)):
        scaled = f"observation[{part.start} + i] * (mjxball_real){1 / scale!r}"
        lines += [f"    for (i = 0; i < 3; i++) input[{offset} + i] = mjxball_tanh({scaled});"]
        offset += 3
    if interface.geometry:
        known = interface.history.size + interface.units
        lines += [f"    mjxball_copy(input + {offset}, memory + {known}, {GEOMETRY_SIZE});"]
    return lines


def _history_update(interface: NetworkInterface) -> str:
    """C lines that advance the memory by one step."""
    lines, history, width = [], interface.history, OBSERVATION_SIZE + ACTION_SIZE
    for k, tau in enumerate(history.filters):
        offset, share = k * width, _literal(-math.expm1(-history.period / tau))
        lines += [f"    mjxball_approach(memory + {offset}, observation, {OBSERVATION_SIZE}, {share});"]
        lines += [f"    mjxball_approach(memory + {offset + OBSERVATION_SIZE}, action, {ACTION_SIZE}, {share});"]
    if history.previous_action:
        lines += [f"    mjxball_copy(memory + {history.past_size - ACTION_SIZE}, action, {ACTION_SIZE});"]
    if history.stale:
        lines += [f"    mjxball_copy(memory + {history.past_size}, observation, {OWN_STATE});"]
    if interface.units:
        lines += [f"    mjxball_copy(memory + {history.size}, next, {interface.units});"]
    return "\n".join(lines)


def _network(interface: NetworkInterface, policy: PolicyFile, int8: bool) -> str:
    """C lines that normalise `input` and call the layers."""
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
    if not interface.units:
        return "\n".join([*lines, *_layers(shapes, calls, "input")])
    units, state = interface.units, f"memory + {interface.history.size}"
    lines += [f"    mjxball_real given[{3 * units}], kept[{3 * units}], next[{units}], joined[{size + 2 * units}];"]
    lines += [_called(f"{calls[0]}, input, given)"), _called(f"{calls[1]}, {state}, kept)")]
    lines += [f"    mjxball_gru(given, kept, {state}, {units}, next);"]
    lines += [f"    mjxball_copy(joined, next, {units});", f"    mjxball_copy(joined + {units}, input, {size});"]
    return "\n".join([*lines, *_layers(shapes[2:], calls[2:], "joined", units)])


def _layers(shapes: Sequence[tuple[int, int]], calls: Sequence[str], source: str, units: int = 0) -> list[str]:
    """C lines with the `calls` of the layers, from `source` through two alternating buffers to `action`.

    The last layer also takes the `units` entries of `next`, a GRU's state.
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
    """C line that calls `layer` and returns from `follow` if it fails."""
    return f"    if (!{layer}) return mjxball_no_answer(follower, action, command);"


def stride(inputs: int) -> int:
    """Length of a padded row of 8-bit weights: `inputs` rounded up to a multiple of 8."""
    return -(-inputs // 8) * 8


def rows_up(outputs: int) -> int:
    """Number of padded rows of weights: `outputs` rounded up to a multiple of 4."""
    return -(-outputs // 4) * 4


def _weights_type(policy: PolicyFile) -> str:
    """C definition of the struct `mjxball_weights`, whose bytes are `weight_bytes`."""
    floats, integers = [f"{kind}[{len(policy.observation_mean)}]" for kind in ("mean", "scale")], []
    for n, (weight, bias) in enumerate(zip(*layers_of(policy), strict=True)):
        inputs, outputs = weight.shape
        floats += [f"step_{n}[{outputs}]", *([f"bias_{n}[{outputs}]"] if bias.size else [])]
        integers += [f"weight_{n}[{rows_up(outputs) * stride(inputs)}]"]
    fields = [*(f"float {one}" for one in floats), *(f"int8_t {one}" for one in integers)]
    return "typedef struct {\n" + "".join(f"    {one};\n" for one in fields) + "} mjxball_weights;\n\n"


def _layers_int8(policy: PolicyFile) -> tuple[list[Rows], list[np.ndarray]]:
    weights, biases = layers_of(policy)
    return [rows_of(weight) for weight in weights], biases


def weight_bytes(policy: PolicyFile) -> bytes:
    """The struct `mjxball_weights` of `policy` as bytes of a little-endian machine."""
    policy = balanced(policy)
    layers, biases = _layers_int8(policy)
    parts = [policy.observation_mean, policy.observation_scale]
    for layer, bias in zip(layers, biases, strict=True):
        parts += [layer.step, bias]
    floats = b"".join(np.asarray(part, "<f4").tobytes() for part in parts)
    return floats + b"".join(_padded(layer.weight).tobytes() for layer in layers)


def float_bytes(policy: PolicyFile) -> bytes:
    """Normalisation, weights and biases of the network as bytes of a little-endian machine."""
    weights, biases = layers_of(policy)
    parts = [*_scaling(policy), *(part for one in zip(weights, biases, strict=True) for part in one)]
    return b"".join(np.asarray(part, "<f4").tobytes() for part in parts)


def _padded(weight: np.ndarray) -> np.ndarray:
    """`weight` (outputs, inputs) padded with zeros to whole rows and columns (`rows_up`, `stride`)."""
    outputs, inputs = weight.shape
    return np.pad(weight, ((0, rows_up(outputs) - outputs), (0, stride(inputs) - inputs)))


def _compiled(policy: PolicyFile) -> str:
    """C definition of the constant `mjxball_compiled`, the 8-bit weights in the header."""
    policy = balanced(policy)
    layers, biases = _layers_int8(policy)
    parts: list[list[str]] = [[_literal(value) for value in part] for part in _scaling(policy)]
    for layer, bias in zip(layers, biases, strict=True):
        parts += [[_literal(value) for value in part] for part in (layer.step, bias) if part.size]
    parts += [[str(value) for value in _padded(layer.weight).ravel()] for layer in layers]
    return "static const mjxball_weights mjxball_compiled = {\n" + ",\n".join(map(_braced, parts)) + "};\n"


def _scaling(policy: PolicyFile) -> tuple[np.ndarray, np.ndarray]:
    return policy.observation_mean, policy.observation_scale


def _braced(literals: Sequence[str]) -> str:
    return "    {" + ",\n     ".join(", ".join(literals[k : k + 16]) for k in range(0, len(literals), 16)) + "}"


def _leader(metadata: dict[str, Any], to: str) -> list[str]:
    """C lines that compute the leader's PD command from the observed error, within the limits, into the array `to`."""
    g = _literal(metadata["gravity"])
    acceleration = [
        f"{_literal(kp)} * observation[{ERROR.start + k}] + {_literal(kd)} * observation[{ERROR_RATE.start + k}]"
        for k, (kp, kd) in enumerate(zip(metadata["leader_kp"], metadata["leader_kd"], strict=True))
    ]
    return [
        f"    {to}[0] = -({acceleration[1]}) / {g};",
        f"    {to}[1] = ({acceleration[0]}) / {g};",
        f"    {to}[2] = {acceleration[2]};",
        f"    for (i = 0; i < 3; i++) {to}[i] = mjxball_clip({to}[i], mjxball_limit[i]);",
    ]


def _command(interface: NetworkInterface) -> str:
    """C lines that compute the command from `action`, which is added to the PD command unless the mode is direct."""
    base = "mjxball_copy_command(observation, command);"
    return "\n".join(
        [
            f"    {base if interface.residual else 'for (i = 0; i < 3; i++) command[i] = 0;'}",
            "    for (i = 0; i < 3; i++)",
            "        command[i] = mjxball_clip(command[i] + mjxball_action_scale[i] * action[i], mjxball_limit[i]);",
        ]
    )
