"""The laws of `control/` and `policy/` as an ONNX graph: they are run once on arrays that only write down what is done.

So the graph is what training and flight compute, not a second version of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from onnx import NodeProto, TensorProto, helper, numpy_helper

Array = Any


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
        if isinstance(value, Traced):
            return value.name
        array = np.asarray(value)
        array = array if array.dtype.kind in "ib" else array.astype(np.float32)
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(array, name))
        return name


class Traced:
    """An array (N, `size`) of the graph, or (N,) with `size` None. Arithmetic on it appends nodes."""

    __array_ufunc__ = None  # NumPy constants on the left defer to the reflected operators
    dtype = np.dtype(np.float32)

    def __init__(self, graph: Graph, name: str, size: int | None):
        self.graph, self.name, self.size = graph, name, size

    def __array_namespace__(self, api_version: str | None = None) -> type[Namespace]:
        return Namespace

    def binary(self, operation: str, left: Any, right: Any) -> Traced:
        """`left` `operation` `right`, one of which is this array."""
        sizes = [value.size if isinstance(value, Traced) else np.shape(value)[-1:] for value in (left, right)]
        widths = [size if isinstance(size, int) else size[0] if size else None for size in sizes]
        return Traced(self.graph, self.graph.add(operation, left, right), widths[0] or widths[1])

    def __getitem__(self, index: Any) -> Traced:
        place = index[-1]
        if self.size is None or index[0] is not Ellipsis:
            raise TypeError(f"only the last axis can be indexed, not {index}")
        if isinstance(place, slice):
            start, stop, _ = place.indices(self.size)
            stop = max(start, stop)
            ends = (np.array([value], np.int64) for value in (start, stop, -1))
            return Traced(self.graph, self.graph.add("Slice", self, *ends), stop - start)
        return Traced(self.graph, self.graph.add("Gather", self, np.array(place, np.int64), axis=-1), None)

    def __neg__(self) -> Traced:
        return Traced(self.graph, self.graph.add("Neg", self), self.size)

    def __matmul__(self, weight: np.ndarray) -> Traced:
        return Traced(self.graph, self.graph.add("MatMul", self, weight), weight.shape[-1])


def _add_operators() -> None:
    for label, operation in (("add", "Add"), ("sub", "Sub"), ("mul", "Mul"), ("truediv", "Div")):
        setattr(Traced, f"__{label}__", lambda a, b, o=operation: a.binary(o, a, b))
        setattr(Traced, f"__r{label}__", lambda a, b, o=operation: a.binary(o, b, a))


_add_operators()


class Namespace:
    """The part of the array namespace that a policy's laws use."""

    sin, cos = staticmethod(np.sin), staticmethod(np.cos)  # of the desired yaw, a constant

    @staticmethod
    def asarray(values: Any, dtype: Any = None) -> Any:
        """Constants stay NumPy arrays."""
        return values if isinstance(values, Traced) else np.asarray(values, np.float32)

    @staticmethod
    def zeros_like(value: Traced) -> Traced:
        """Zeros (N, size)."""
        return value.binary("Sub", value, value)

    @staticmethod
    def tanh(value: Traced) -> Traced:
        """Elementwise."""
        return Traced(value.graph, value.graph.add("Tanh", value), value.size)

    @staticmethod
    def maximum(value: Traced, other: Any) -> Traced:
        """Elementwise."""
        return value.binary("Max", value, other)

    @staticmethod
    def clip(value: Traced, low: Any, high: Any) -> Traced:
        """Elementwise."""
        return value.binary("Min", value.binary("Max", value, low), high)

    @staticmethod
    def concat(values: Sequence[Traced], axis: int) -> Traced:
        """Join along the last axis; empty parts are left out."""
        parts = [value for value in values if value.size] or list(values[:1])
        if len(parts) == 1:
            return parts[0]
        name = parts[0].graph.add("Concat", *parts, axis=-1)
        return Traced(parts[0].graph, name, sum(part.size or 0 for part in parts))

    @staticmethod
    def stack(values: Sequence[Traced], axis: int) -> Traced:
        """Join (N,) arrays along a new last axis."""
        last = np.array([-1], np.int64)
        parts = [Traced(value.graph, value.graph.add("Unsqueeze", value, last), 1) for value in values]
        return Namespace.concat(parts, axis=-1)
