"""A policy as an ONNX model, with its memory as an input and an output.

The laws of `control/` and `policy/` run once on arrays that only write down what is done, so the graph is what training
and flight compute, not a second version of it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from onnx import NodeProto, TensorProto, helper, numpy_helper

from mjxball.control import observation as layout
from mjxball.policy.file import PolicyFile, law_of
from mjxball.policy.policy import NetworkLaw, Policy

Array = Any
OPSET, IR_VERSION = 17, 8  # of 2022: read by every runtime of the last years
BATCH = "flights"


class Graph:
    """Nodes and constants of a graph that is being written."""

    def __init__(self) -> None:
        self.nodes: list[NodeProto] = []
        self.constants: list[TensorProto] = []

    def add(self, operation: str, *inputs: Any, **attributes: Any) -> str:
        """Append a node and return its output's name."""
        name = f"{operation.lower()}_{len(self.nodes)}"
        names = [self.name_of(value) for value in inputs]
        self.nodes.append(helper.make_node(operation, names, [name], name=name, **attributes))
        return name

    def name_of(self, value: Any) -> str:
        """The name of a traced array, or of a constant, which is added."""
        if isinstance(value, TracedArray):
            return value.name
        array = np.asarray(value)
        array = array if array.dtype.kind in "ib" else array.astype(np.float32)
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(array, name))
        return name


class TracedArray:
    """An array (N, `size`) of the graph, or (N,) with `size` None. Arithmetic on it appends nodes."""

    __array_ufunc__ = None  # NumPy constants on the left defer to the reflected operators
    dtype = np.dtype(np.float32)

    def __init__(self, graph: Graph, name: str, size: int | None):
        self.graph, self.name, self.size = graph, name, size

    def __array_namespace__(self, api_version: str | None = None) -> type[Namespace]:
        return Namespace

    def binary(self, operation: str, left: Any, right: Any) -> TracedArray:
        """`left` `operation` `right`, one of which is this array."""
        sizes = [value.size if isinstance(value, TracedArray) else np.shape(value)[-1:] for value in (left, right)]
        widths = [size if isinstance(size, int) else size[0] if size else None for size in sizes]
        return TracedArray(self.graph, self.graph.add(operation, left, right), widths[0] or widths[1])

    def __getitem__(self, index: Any) -> TracedArray:
        place = index[-1]
        if self.size is None or index[0] is not Ellipsis:
            raise TypeError(f"only the last axis can be indexed, not {index}")
        if isinstance(place, slice):
            start, stop, _ = place.indices(self.size)
            stop = max(start, stop)
            ends = (np.array([value], np.int64) for value in (start, stop, -1))
            return TracedArray(self.graph, self.graph.add("Slice", self, *ends), stop - start)
        return TracedArray(self.graph, self.graph.add("Gather", self, np.array(place, np.int64), axis=-1), None)

    def __neg__(self) -> TracedArray:
        return TracedArray(self.graph, self.graph.add("Neg", self), self.size)

    def __matmul__(self, weight: np.ndarray) -> TracedArray:
        return TracedArray(self.graph, self.graph.add("MatMul", self, weight), weight.shape[-1])


def _add_operators() -> None:
    for label, operation in (("add", "Add"), ("sub", "Sub"), ("mul", "Mul"), ("truediv", "Div")):
        setattr(TracedArray, f"__{label}__", lambda a, b, o=operation: a.binary(o, a, b))
        setattr(TracedArray, f"__r{label}__", lambda a, b, o=operation: a.binary(o, b, a))


_add_operators()


class Namespace:
    """The part of the array namespace that a policy's laws use."""

    sin = staticmethod(np.sin)  # of the desired yaw, a constant

    @staticmethod
    def cos(value: Any) -> Any:
        """Elementwise; of a constant it is one."""
        if not isinstance(value, TracedArray):
            return np.cos(value)
        return TracedArray(value.graph, value.graph.add("Cos", value), value.size)

    @staticmethod
    def asarray(values: Any, dtype: Any = None) -> Any:
        """Constants stay NumPy arrays."""
        return values if isinstance(values, TracedArray) else np.asarray(values, np.float32)

    @staticmethod
    def zeros_like(value: TracedArray) -> TracedArray:
        """Zeros (N, size)."""
        return value.binary("Sub", value, value)

    @staticmethod
    def tanh(value: TracedArray) -> TracedArray:
        """Elementwise."""
        return TracedArray(value.graph, value.graph.add("Tanh", value), value.size)

    @staticmethod
    def maximum(value: TracedArray, other: Any) -> TracedArray:
        """Elementwise."""
        return value.binary("Max", value, other)

    @staticmethod
    def clip(value: TracedArray, low: Any, high: Any) -> TracedArray:
        """Elementwise."""
        return value.binary("Min", value.binary("Max", value, low), high)

    @staticmethod
    def concat(values: Sequence[TracedArray], axis: int) -> TracedArray:
        """Join along the last axis; empty parts are left out."""
        parts = [value for value in values if value.size] or list(values[:1])
        if len(parts) == 1:
            return parts[0]
        name = parts[0].graph.add("Concat", *parts, axis=-1)
        return TracedArray(parts[0].graph, name, sum(part.size or 0 for part in parts))

    @staticmethod
    def stack(values: Sequence[TracedArray], axis: int) -> TracedArray:
        """Join (N,) arrays along a new last axis."""
        last = np.array([-1], np.int64)
        parts = [TracedArray(value.graph, value.graph.add("Unsqueeze", value, last), 1) for value in values]
        return Namespace.concat(parts, axis=-1)


def onnx_model(contents: PolicyFile, name: str) -> Any:
    """The ONNX model of a policy.

    Inputs: `observation` (N, 18); with a memory of m numbers also `memory` (N, m) and `start` (N, 1) bool, true at
    the first step of a flight, where `memory` is not read. Outputs: `action` (N, 3) in [-1, 1], `command` (N, 3)
    roll [rad], pitch [rad], vertical acceleration [m/s2]; with a memory also `next_memory` (N, m).
    """
    graph, around = Graph(), law_of(contents.card)
    observation = TracedArray(graph, "observation", layout.OBSERVATION_SIZE)
    inputs = [_value("observation", TensorProto.FLOAT, layout.OBSERVATION_SIZE)]
    memory = around.start(observation)
    if around.size:
        inputs += [_value("memory", TensorProto.FLOAT, around.size), _value("start", TensorProto.BOOL, 1)]
        start, given = TracedArray(graph, "start", 1), TracedArray(graph, "memory", around.size)
        memory = TracedArray(graph, graph.add("Where", start, memory, given), around.size)
    results = dict(zip(("action", "command", "next_memory"), _answers(contents, observation, memory), strict=True))
    if not around.size:
        del results["next_memory"]
    for label, value in results.items():
        graph.nodes.append(helper.make_node("Identity", [value.name], [label], name=label))
    outputs = [_value(label, TensorProto.FLOAT, value.size) for label, value in results.items()]
    made = helper.make_graph(graph.nodes, "follower", inputs, outputs, graph.constants, doc_string=onnx_model.__doc__)
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="mjxball")
    model.ir_version = IR_VERSION
    helper.set_model_props(model, {"name": name, "card": json.dumps(contents.card, sort_keys=True)})
    onnx.checker.check_model(model, full_check=True)
    return model


def _answers(
    contents: PolicyFile, observation: TracedArray, memory: TracedArray
) -> tuple[TracedArray, TracedArray, TracedArray]:
    """Action, command and next memory, by the laws that fly."""
    return NetworkLaw(Policy(contents, "traced", np.float32)).answer(memory, observation)


def _value(name: str, kind: int, size: int | None) -> Any:
    return helper.make_tensor_value_info(name, kind, [BATCH, size])
