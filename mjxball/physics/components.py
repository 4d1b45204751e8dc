"""Arrays split into their components, so that XLA fuses a control step into few large kernels.

The laws are written once against the array namespace of their inputs: they stack, index and concatenate along
trailing axes. On ordinary JAX arrays every `stack` is a concatenation in memory, which ends a fused kernel. A
`Components` behaves like an array whose trailing axes are Python-side (a NumPy object array) and whose elements
are whole JAX arrays, one per component: stacking and indexing cost nothing, only arithmetic reaches XLA.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Array = Any


def _objects(values: Any) -> np.ndarray:
    """`values` as an object array; a JAX array or tracer is one element, not a sequence."""
    if isinstance(values, Components):
        return values.data
    if isinstance(values, np.ndarray) and values.dtype != object:
        return values.astype(object)
    if isinstance(values, np.ndarray):
        return values
    result = np.empty((), object)
    result[()] = values
    return result


def _map(function: Callable[..., Any], *values: Any) -> Components:
    arrays = np.broadcast_arrays(*map(_objects, values), subok=False)
    result = np.empty(arrays[0].shape, object)
    for index in np.ndindex(result.shape):
        result[index] = function(*(array[index] for array in arrays))
    return Components(result)


class Components:
    """An array of trailing shape `data.shape` whose elements are JAX arrays of any one batch shape."""

    __array_ufunc__ = None  # NumPy arrays on the left defer to the reflected operators below

    def __init__(self, data: np.ndarray):
        self.data = data

    @property
    def shape(self) -> tuple[int, ...]:
        """The trailing shape; the batch is inside the elements."""
        return self.data.shape

    @property
    def dtype(self) -> Any:
        """The floating type of the first element."""
        return jnp.result_type(self.data.flat[0]) if self.data.size else jnp.result_type(float)

    def __array_namespace__(self, api_version: str | None = None) -> type[Namespace]:
        return Namespace

    def __getitem__(self, index: Any) -> Components:
        picked = self.data[index]
        return Components(picked if isinstance(picked, np.ndarray) else _objects(picked))

    def __iter__(self) -> Any:
        return (self[i] for i in range(len(self.data)))

    def sum(self, axis: int = -1) -> Components:
        """Sum over one trailing axis."""
        parts = np.moveaxis(self.data, axis, 0)
        if not len(parts):
            return Components(np.zeros(parts.shape[1:], object))
        total = Components(parts[0]) if isinstance(parts[0], np.ndarray) else Components(_objects(parts[0]))
        for part in parts[1:]:
            total = operator.add(total, Components(_objects(part)))
        return total

    def __neg__(self) -> Components:
        return _map(operator.neg, self)


def _add_operators() -> None:
    for name in ("add", "sub", "mul", "truediv", "pow", "lt", "le", "gt", "ge", "and_", "or_"):
        function = getattr(operator, name)
        label = name.rstrip("_")
        setattr(Components, f"__{label}__", lambda a, b, f=function: _map(f, a, b))
        setattr(Components, f"__r{label}__", lambda a, b, f=function: _map(f, b, a))


_add_operators()


def _each(function: Callable[..., Any]) -> Any:
    return staticmethod(lambda *values: _map(function, *values))


class Namespace:
    """The part of the array namespace that the laws use."""

    sin, cos, asin, atan2 = _each(jnp.sin), _each(jnp.cos), _each(jnp.arcsin), _each(jnp.arctan2)
    sqrt, tanh, abs = _each(jnp.sqrt), _each(jnp.tanh), _each(jnp.abs)
    maximum, minimum, where = _each(jnp.maximum), _each(jnp.minimum), _each(jnp.where)
    clip = _each(jnp.clip)
    zeros_like = _each(jnp.zeros_like)

    @staticmethod
    def asarray(values: Any, dtype: Any = None) -> Components:
        """Constants become Python numbers, which XLA folds."""
        if isinstance(values, Components):
            return values
        if isinstance(values, (list, tuple)) and any(isinstance(value, (Components, jax.Array)) for value in values):
            return Namespace.stack(list(values), axis=-1)
        return Components(_objects(np.asarray(values)))

    @staticmethod
    def stack(values: Sequence[Any], axis: int) -> Components:
        """Join along a new trailing axis."""
        return Components(np.stack(np.broadcast_arrays(*map(_objects, values)), axis=axis))

    @staticmethod
    def concat(values: Sequence[Any], axis: int) -> Components:
        """Join along a trailing axis."""
        return Components(np.concatenate([_objects(value) for value in values], axis=axis))


def _flatten(value: Components) -> tuple[list[Any], tuple[int, ...]]:
    return list(value.data.flat), value.shape


def _unflatten(shape: tuple[int, ...], leaves: Any) -> Components:
    data = np.empty(shape, object)
    for index, leaf in zip(np.ndindex(shape), leaves, strict=True):
        data[index] = leaf
    return Components(data)


# Compiled loops can carry split state: no kernel then spends time on joining and splitting.
jax.tree_util.register_pytree_node(Components, _flatten, _unflatten)


def split(array: Array, trailing: int) -> Components:
    """Split the last `trailing` axes of a JAX `array` into components."""
    result = np.empty(array.shape[array.ndim - trailing :], object)
    for index in np.ndindex(result.shape):
        result[index] = array[(..., *index)]
    return Components(result)


def join(components: Components) -> Array:
    """The JAX array (batch, *trailing) of `components`."""
    flat = jnp.stack([jnp.asarray(value) for value in components.data.flat], axis=-1)
    return flat.reshape(*flat.shape[:-1], *components.shape)
