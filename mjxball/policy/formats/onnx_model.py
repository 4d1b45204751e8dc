"""A policy as an ONNX model, with its memory as an input and an output.

The controller in `control/` and `policy/` runs once on arrays that record operations instead of computing. The graph is
therefore what training and flight compute, not a second implementation of it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
from onnx import NodeProto, TensorProto, helper, numpy_helper

from mjxball import __version__
from mjxball.control import observation as layout
from mjxball.control.followers import MAX_OBSERVATION
from mjxball.policy.file import PolicyFile, interface_of
from mjxball.policy.inference import NetworkController, Policy, known_geometry

OPSET, IR_VERSION = 17, 8  # of 2022: read by every runtime of the last years
BATCH = "flights"


class Graph:
    """Nodes and constants of the graph that is being written."""

    def __init__(self) -> None:
        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []

    def add(self, operation: str, *inputs: Any, **attributes: Any) -> str:
        """Append a node and return the name of its output."""
        name = f"{operation.lower()}_{len(self.nodes)}"
        names = [self.name_of(value) for value in inputs]
        self.nodes.append(helper.make_node(operation, names, [name], name=name, **attributes))
        return name

    def name_of(self, value: Any) -> str:
        """The name of `value`: a traced array, or a constant, which is added to the graph."""
        if isinstance(value, TracedArray):
            return value.name
        array = np.asarray(value)
        array = array if array.dtype.kind in "ib" else array.astype(np.float32)
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(array, name))
        return name


class TracedArray:
    """An array (N, *`sizes`) of the graph. Arithmetic and indexing behind N append nodes."""

    __array_ufunc__ = None  # NumPy constants on the left defer to the reflected operators
    dtype = np.dtype(np.float32)

    def __init__(self, graph: Graph, name: str, *sizes: int):
        self.graph, self.name, self.sizes = graph, name, sizes

    def __array_namespace__(self, api_version: str | None = None) -> SimpleNamespace:
        return NAMESPACE

    @property
    def shape(self) -> tuple[int | None, ...]:
        """None, for the N that is known when the model runs, and the sizes behind it."""
        return (None, *self.sizes)

    def unary(self, operation: str) -> TracedArray:
        """`operation` of every element."""
        return TracedArray(self.graph, self.graph.add(operation, self), *self.sizes)

    def binary(self, operation: str, left: Any, right: Any) -> TracedArray:
        """`operation` of `left` and `right`, one of which is this array; they broadcast."""
        sizes = [value.sizes if isinstance(value, TracedArray) else np.shape(value) for value in (left, right)]
        return TracedArray(self.graph, self.graph.add(operation, left, right), *np.broadcast_shapes(*sizes))

    def __getitem__(self, index: Any) -> TracedArray:
        first, *places = index
        if first is not Ellipsis:
            raise TypeError(f"the flights cannot be indexed: {index}")
        found = self
        axis = 1 + len(self.sizes) - sum(place is not None for place in places)
        for place in places:
            found, step = found._along(axis, place)
            axis += step
        return found

    def _along(self, axis: int, place: Any) -> tuple[TracedArray, int]:
        """(the array indexed by `place` on `axis`, where axis 0 is N; how many axes further the next index applies)."""
        before, after = self.sizes[: axis - 1], self.sizes[axis:]
        if place is None:
            name = self.graph.add("Unsqueeze", self, np.array([axis], np.int64))
            return TracedArray(self.graph, name, *before, 1, *self.sizes[axis - 1 :]), 1
        size = self.sizes[axis - 1]
        if isinstance(place, slice):
            start, stop, _ = place.indices(size)
            stop = max(start, stop)
            ends = (np.array([value], np.int64) for value in (start, stop, axis))
            return TracedArray(self.graph, self.graph.add("Slice", self, *ends), *before, stop - start, *after), 1
        name = self.graph.add("Gather", self, np.array(place % size, np.int64), axis=axis)
        return TracedArray(self.graph, name, *before, *after), 0

    def __neg__(self) -> TracedArray:
        return self.unary("Neg")

    def __matmul__(self, weight: np.ndarray) -> TracedArray:
        return TracedArray(self.graph, self.graph.add("MatMul", self, weight), *self.sizes[:-1], weight.shape[-1])


for label, operation in (("add", "Add"), ("sub", "Sub"), ("mul", "Mul"), ("truediv", "Div")):
    setattr(TracedArray, f"__{label}__", lambda a, b, o=operation: a.binary(o, a, b))
    setattr(TracedArray, f"__r{label}__", lambda a, b, o=operation: a.binary(o, b, a))


def _concat(values: Sequence[TracedArray], axis: int) -> TracedArray:
    """Join along the last axis; empty arrays are left out."""
    parts = [value for value in values if value.sizes[-1]] or list(values[:1])
    return parts[0] if len(parts) == 1 else _joined(parts, -1)


def _stack(values: Sequence[TracedArray], axis: int) -> TracedArray:
    """Join along a new `axis`, counted from the end."""
    places = (slice(None),) * (-1 - axis)
    return _joined([value[(..., None, *places)] for value in values], axis)


def _all(value: TracedArray, axis: int, keepdims: bool) -> TracedArray:
    """Whether all of the last axis are true, as an axis of size 1."""
    number = TracedArray(value.graph, value.graph.add("Cast", value, to=TensorProto.FLOAT), *value.sizes)
    total = number @ np.ones((value.sizes[-1], 1))  # no reduction, as in `_is_below`
    return total.binary("Equal", total, np.array([value.sizes[-1]], np.float32))


def _where(condition: TracedArray, one: Any, other: Any) -> TracedArray:
    """`one` where `condition` is true, else `other`; they broadcast."""
    sizes = [value.sizes if isinstance(value, TracedArray) else np.shape(value) for value in (condition, one, other)]
    graph = condition.graph
    return TracedArray(graph, graph.add("Where", condition, one, other), *np.broadcast_shapes(*sizes))


def _joined(parts: Sequence[TracedArray], axis: int) -> TracedArray:
    sizes = list(parts[0].sizes)
    sizes[axis] = sum(part.sizes[axis] for part in parts)
    return TracedArray(parts[0].graph, parts[0].graph.add("Concat", *parts, axis=axis), *sizes)


NAMESPACE = SimpleNamespace(  # the part of the array API that controllers use
    __name__="traced",
    asarray=lambda values, dtype=None: values if isinstance(values, TracedArray) else np.asarray(values, np.float32),
    zeros_like=lambda value: value.binary("Sub", value, value),
    tanh=lambda value: value.unary("Tanh"),
    maximum=lambda value, other: value.binary("Max", value, other),
    equal=lambda value, other: value.binary("Equal", value, other),
    all=_all,
    where=_where,
    clip=lambda value, low, high: value.binary("Min", value.binary("Max", value, low), high),
    concat=_concat,
    stack=_stack,
)


def onnx_model(contents: PolicyFile, name: str) -> Any:
    """The ONNX model of a policy.

    Inputs: `observation` (N, 18); with a memory of m numbers also `memory` (N, m), and `start` (N, 1) bool, true at the
    first step of a flight, where `memory` is not read. Outputs: `action` (N, 3) in [-1, 1]; `command` (N, 3): roll,
    pitch [rad], vertical acceleration [m/s2]; with a memory `next_memory` (N, m); `valid` (N, 1) bool.

    In a row that is not valid action and command are zeros, and other rows are not affected. There are two causes. If
    the observation is not finite, or its absolute sum is 1e6 or more, `next_memory` is `memory`, or at a start the
    memory after an observation of zeros. If the memory or the answer is not finite, `next_memory` is the memory of a
    start.

    A policy that needs the geometry of its team is exported for one follower, named by `team` in its metadata. That
    follower observes and commands in its mount frame.
    """
    graph, around = Graph(), interface_of(contents.metadata)
    controller = NetworkController(Policy(contents, "traced", np.float32))
    observation = TracedArray(graph, "observation", layout.OBSERVATION_SIZE)
    inputs = [_value("observation", TensorProto.FLOAT, layout.OBSERVATION_SIZE)]
    sound = _is_below(MAX_OBSERVATION, observation)
    seen = _where(sound, observation, np.zeros(1))
    begun = memory = around.start(seen, known_geometry(contents.metadata, name))
    if around.size:
        inputs += [_value("memory", TensorProto.FLOAT, around.size), _value("start", TensorProto.BOOL, 1)]
        memory = _where(TracedArray(graph, "start", 1), begun, TracedArray(graph, "memory", around.size))
    action, command, following = controller.answer(memory, seen)
    finite = _is_below(float(np.finfo(np.float32).max), *([memory, following] if around.size else []), action, command)
    valid = sound.binary("And", sound, finite)
    results = {label: _where(valid, value, np.zeros(1)) for label, value in (("action", action), ("command", command))}
    if around.size:
        results["next_memory"] = _where(finite, _where(sound, following, memory), begun)
    results["valid"] = valid
    for label, value in results.items():
        graph.nodes.append(helper.make_node("Identity", [value.name], [label], name=label))
    kinds = {"valid": TensorProto.BOOL}
    outputs = [_value(label, kinds.get(label, TensorProto.FLOAT), *value.sizes) for label, value in results.items()]
    made = helper.make_graph(graph.nodes, "follower", inputs, outputs, graph.constants, doc_string=onnx_model.__doc__)
    maker = {"producer_name": "mjxball", "producer_version": __version__}
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)], **maker)
    model.ir_version = IR_VERSION
    helper.set_model_props(model, {"name": name, "card": json.dumps(contents.metadata, sort_keys=True)})
    onnx.checker.check_model(model, full_check=True)
    return model


def _is_below(limit: float, *parts: TracedArray) -> TracedArray:
    """Whether the absolute sum of a row is below `limit` (N, 1); false for rows with NaN or infinity."""
    size = _concat(parts, -1).unary("Abs")
    total = size @ np.ones((size.sizes[-1], 1))  # ReduceSum fails in runtimes if N is 0
    return total.binary("Less", total, np.array([limit]))


def _value(name: str, kind: int, size: int | None) -> Any:
    return helper.make_tensor_value_info(name, kind, [BATCH, size])
