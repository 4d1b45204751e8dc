"""Scalar form: a function of small arrays as operations on scalars, which XLA fuses into few loops over the batch."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

Value = Any  # an array, or `Parts`
Parts = Any  # object array, each element a tracer (of the batch, or a scalar) or a NumPy scalar
MAX_ITEMS = 12  # size; operations on larger arrays are kept, since in scalar form they compile longer and run no faster
CALLS = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "custom_jvp_call": "call_jaxpr"}
ELEMENTWISE = frozenset(
    (
        *("abs", "acos", "add", "add_any", "and", "asin", "atan", "atan2", "bitcast_convert_type", "ceil", "clamp"),
        *("convert_element_type", "copy", "cos", "div", "eq", "exp", "exp2", "expm1", "floor", "ge", "gt"),
        *("integer_pow", "is_finite", "le", "log", "log1p", "logistic", "lt", "max", "min", "mul", "ne", "neg", "not"),
        *("or", "pow", "rem", "round", "rsqrt", "select_n", "sign", "sin", "sqrt", "square", "stop_gradient", "sub"),
        *("tan", "tanh", "xor"),
    )
)
REDUCTIONS: dict[str, Callable[[Any, Any], Any]] = {
    "reduce_and": operator.and_,
    "reduce_max": jnp.maximum,
    "reduce_min": jnp.minimum,
    "reduce_or": operator.or_,
    "reduce_sum": operator.add,
}


def scalar_form(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jax.vmap(function)` for a `function` of pytrees of arrays, computed element by element over the batch.

    Slices, stacks and transposes of small arrays vanish, and so do products with constants that are 0 (0 times infinity
    is then 0). Sums are added in order. A `lax.scan` without inputs and outputs for each step, such as `fori_loop` of a
    fixed count, is recomputed for its gradient instead of storing intermediate values. Operations that are unknown here
    or have an array larger than `MAX_ITEMS` are kept, and so is a call (`jax.jit`) that contains one.
    The result has reverse-mode gradients only (`jax.grad`, `jax.vjp`).
    """

    def transformed(*arguments: Any) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        shapes = [jax.ShapeDtypeStruct(jnp.shape(leaf)[1:], jax.dtypes.result_type(leaf)) for leaf in leaves]
        closed, result = jax.make_jaxpr(
            lambda *leaves: function(*jax.tree.unflatten(structure, leaves)), return_shape=True
        )(*shapes)
        values = _evaluate(closed.jaxpr, closed.consts, _split(leaves))
        count = jnp.shape(leaves[0])[:1]
        outputs = [_array(value, v.aval) for value, v in zip(values, closed.jaxpr.outvars, strict=True)]
        batched = [
            one if jnp.ndim(one) > len(v.aval.shape) else jnp.broadcast_to(one, (*count, *v.aval.shape))
            for one, v in zip(outputs, closed.jaxpr.outvars, strict=True)
        ]
        return jax.tree.unflatten(jax.tree.structure(result), batched)

    return transformed


def _split(leaves: Sequence[Any]) -> list[Value]:
    """`leaves` (batch, ...) with small arrays as `Parts`. Gradients of an array's elements are stacked once."""
    small = [
        k
        for k, leaf in enumerate(leaves)
        if jnp.ndim(leaf) > 1 and 0 < leaf.size // len(leaf) <= MAX_ITEMS and jnp.issubdtype(leaf.dtype, jnp.floating)
    ]
    shapes = [leaves[k].shape for k in small]

    @jax.custom_vjp
    def elements(*arrays: Any) -> list[list[Any]]:
        return [_elements(array, 1) for array in arrays]

    def stacked(_: None, gradients: list[list[Any]]) -> tuple[Any, ...]:
        return tuple(jnp.stack(gradient, 1).reshape(shape) for gradient, shape in zip(gradients, shapes, strict=True))

    elements.defvjp(lambda *arrays: (elements(*arrays), None), stacked)
    values: list[Value] = list(leaves)
    for k, shape, flat in zip(small, shapes, elements(*(leaves[k] for k in small)), strict=True):
        values[k] = _shaped(flat, shape[1:])
    return values


def _elements(array: Any, batched: int) -> list[Any]:
    """The elements of `array` in row-major order, without its first axis, the batch, if `batched` is 1."""
    flat = jax.lax.reshape(array, (*array.shape[:batched], math.prod(array.shape[batched:])))
    each = range(flat.shape[-1])
    return [jax.lax.squeeze(jax.lax.slice_in_dim(flat, k, k + 1, axis=batched), (batched,)) for k in each]


def _shaped(elements: Sequence[Any], shape: tuple[int, ...]) -> Parts:
    parts = np.empty(shape, object)
    for index, element in zip(np.ndindex(shape), elements, strict=True):
        parts[index] = element
    return parts


def _evaluate(jaxpr: Any, constants: Sequence[Any], arguments: Sequence[Value]) -> list[Value]:
    values: dict[Any, Value] = {}

    def read(variable: Any) -> Value:
        return np.asarray(variable.val) if isinstance(variable, core.Literal) else values[variable]

    values.update(zip(jaxpr.constvars, constants, strict=True))
    values.update(zip(jaxpr.invars, arguments, strict=True))
    for equation in jaxpr.eqns:
        results = _apply(equation, [read(variable) for variable in equation.invars])
        values.update(zip(equation.outvars, results, strict=True))
    return [read(variable) for variable in jaxpr.outvars]


def _apply(equation: Any, inputs: list[Value]) -> Sequence[Value]:
    """Results of `equation` for `inputs`, in scalar form if it is known and small."""
    name, parameters = equation.primitive.name, equation.params
    if name in CALLS and parameters.get(CALLS[name]) is not None:
        called = parameters[CALLS[name]]
        if _largest(called.jaxpr) > MAX_ITEMS:
            return _on_arrays(equation, inputs)
        return _evaluate(called.jaxpr, called.consts, inputs)
    if name == "scan" and _repeats(equation):
        return _scan(parameters["jaxpr"], parameters["length"], inputs)
    avals, shape = [variable.aval for variable in (*equation.invars, *equation.outvars)], equation.outvars[0].aval.shape
    # A change of type (`bitcast_convert_type`) may turn one element into several.
    broadcasts = all(_broadcasts_to(aval.shape, shape) for aval in avals)
    rewritten = (name in ELEMENTWISE and broadcasts) or name in REDUCTIONS or name in REARRANGED
    keys = any(jnp.issubdtype(aval.dtype, jax.dtypes.extended) for aval in avals)
    sizes = [aval.size for aval in avals]
    if keys or not rewritten or max(sizes) > MAX_ITEMS or min(sizes) == 0:
        return _on_arrays(equation, inputs)
    parts = [_parts(value, variable.aval) for value, variable in zip(inputs, equation.invars, strict=True)]
    if name in REARRANGED:
        result = REARRANGED[name](parameters, shape, parts)
        return result if equation.primitive.multiple_results else [result]
    if name in REDUCTIONS:
        return [_reduce(REDUCTIONS[name], parts[0], parameters["axes"])]
    operands = [np.broadcast_to(part, shape) for part in parts]
    outputs = np.empty(shape, object)
    for index in np.ndindex(shape):
        outputs[index] = _compute(equation, [part[index] for part in operands])
    return [outputs]


def _on_arrays(equation: Any, inputs: list[Value]) -> Sequence[Value]:
    """Results of `equation` for `inputs`, computed on whole arrays by `jax.vmap`."""
    arrays = [_array(value, variable.aval) for value, variable in zip(inputs, equation.invars, strict=True)]
    pairs = zip(arrays, equation.invars, strict=True)
    axes = tuple(0 if jnp.ndim(array) > len(variable.aval.shape) else None for array, variable in pairs)
    bind = functools.partial(equation.primitive.bind, **equation.params)
    outputs = jax.vmap(bind, axes)(*arrays) if 0 in axes else bind(*arrays)
    return outputs if equation.primitive.multiple_results else [outputs]


def _largest(jaxpr: Any) -> int:
    """Size of the largest array in `jaxpr`."""
    return max((v.aval.size for e in jaxpr.eqns for v in (*e.invars, *e.outvars) if hasattr(v.aval, "size")), default=0)


def _broadcasts_to(operand: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    """Whether an array of the shape `operand`, a scalar or with as many axes as `shape`, broadcasts to `shape`."""
    return operand == () or (
        len(operand) == len(shape) and all(one in (1, other) for one, other in zip(operand, shape, strict=True))
    )


def _repeats(scan: Any) -> bool:
    """Whether `scan` has no inputs or outputs for each step, which would have one more axis than in its body."""
    body = scan.params["jaxpr"]
    inner, outer = [*body.in_avals, *body.out_avals], [v.aval for v in (*scan.invars, *scan.outvars)]
    return all(one.shape == other.shape for one, other in zip(inner, outer, strict=True))


def _scan(body: Any, length: int, inputs: list[Value]) -> list[Value]:
    """`body` repeated `length` times. Its last inputs are carried; those before them are the same in every step."""
    count = len(inputs) - len(body.out_avals)
    shapes = body.out_avals
    parts = [_parts(value, aval) for value, aval in zip(inputs, body.in_avals, strict=True)]
    batch = _batch([one for part in parts for one in part.flat])

    def flatten(values: Sequence[Value]) -> list[Any]:
        every = [(one, aval.dtype) for v, aval in zip(values, shapes, strict=True) for one in _parts(v, aval).flat]
        return [jnp.broadcast_to(jnp.asarray(one, kind), batch) for one, kind in every]

    def unflatten(flat: Sequence[Any]) -> list[Parts]:
        values, rest = [], list(flat)
        for aval in shapes:
            values.append(_shaped(rest[: aval.size], aval.shape))
            rest = rest[aval.size :]
        return values

    # Traced elements of the inputs that stay the same are arguments of the loop, because they have gradients.
    same = parts[:count]
    traced = [one for part in same for one in part.flat if not _is_constant(one)]

    def step(traced: list[Any], flat: list[Any]) -> list[Any]:
        rest = iter(traced)
        filled = [np.empty(part.shape, object) for part in same]
        for part, template in zip(filled, same, strict=True):
            for index in np.ndindex(template.shape):
                part[index] = template[index] if _is_constant(template[index]) else next(rest)
        return flatten(_evaluate(body.jaxpr, body.consts, [*filled, *unflatten(flat)]))

    return unflatten(_repeated(step, length)(traced, flatten(parts[count:])))


def _repeated(step: Callable[[list[Any], list[Any]], list[Any]], length: int) -> Callable[..., list[Any]]:
    """Function (same, value) that repeats value = step(same, value) `length` times.

    Its gradient is explicit, because JAX takes a second longer to derive that of a loop with `jax.checkpoint`.
    """

    @jax.custom_vjp
    def repeat(same: list[Any], value: list[Any]) -> list[Any]:
        return jax.lax.scan(lambda value, _: (step(same, value), None), value, length=length)[0]

    def forward(same: list[Any], value: list[Any]) -> tuple[list[Any], Any]:
        last, every = jax.lax.scan(lambda value, _: (step(same, value), value), value, length=length)
        return last, (same, every)

    def backward(residuals: Any, gradient: list[Any]) -> tuple[list[Any], list[Any]]:
        same, every = residuals

        def back(carry: tuple[list[Any], list[Any]], value: list[Any]) -> tuple[Any, None]:
            gradient, total = carry
            _, pull = jax.vjp(step, same, value)
            more, gradient = pull(gradient)
            return (gradient, [a + b for a, b in zip(total, more, strict=True)]), None

        zeros = [jnp.zeros_like(one) for one in same]
        (gradient, total), _ = jax.lax.scan(back, (gradient, zeros), every, reverse=True)
        return total, gradient

    repeat.defvjp(forward, backward)
    return repeat


def _parts(value: Value, aval: Any) -> Parts:
    """`value` as `Parts` of the shape of `aval`, which is without the batch."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        return value
    batched = jnp.ndim(value) - len(aval.shape)
    if batched or isinstance(value, jax.core.Tracer):
        return _shaped(_elements(value, batched), aval.shape)
    return _shaped(list(np.asarray(value).ravel()), aval.shape)


def _array(value: Value, aval: Any) -> Any:
    """`value` as one array, with the batch axis first if any element has one."""
    if not (isinstance(value, np.ndarray) and value.dtype == object):
        return value
    if all(map(_is_constant, value.flat)):
        return np.array(value.tolist(), aval.dtype).reshape(aval.shape)
    batch = _batch(value.flat)
    if not aval.shape:
        return jnp.asarray(value[()], aval.dtype)
    elements = [jnp.broadcast_to(jnp.asarray(element, aval.dtype), batch) for element in value.flat]
    return jnp.stack(elements, len(batch)).reshape(batch + aval.shape)


def _is_constant(element: Any) -> bool:
    return isinstance(element, np.generic)


def _batch(elements: Iterable[Any]) -> tuple[int, ...]:
    """Shape of the batch, (n,), or () if none of `elements` has a batch axis."""
    return np.broadcast_shapes(*(np.shape(element) for element in elements))


def _is(element: Any, constant: float) -> bool:
    return _is_constant(element) and element.dtype != bool and element == constant


def _add(a: Any, b: Any) -> Any:
    return b if _is(a, 0) else a if _is(b, 0) else a + b


def _subtract(a: Any, b: Any) -> Any:
    return a if _is(b, 0) else -b if _is(a, 0) else a - b


def _multiply(a: Any, b: Any) -> Any:
    if _is(a, 0) or _is(b, 0):
        return (a if _is_constant(a) else b).dtype.type(0)
    return b if _is(a, 1) else a if _is(b, 1) else a * b


def _divide(a: Any, b: Any) -> Any:
    if _is(a, 0) or _is(b, 1):
        return a
    if jnp.issubdtype(a.dtype, jnp.integer):  # rounds to zero
        return jax.lax.div(*jnp.broadcast_arrays(a, b))
    return a / b


# Operations that need no computation if an operand is the constant 0 or 1.
SIMPLIFIED = {"add": _add, "add_any": _add, "sub": _subtract, "mul": _multiply, "div": _divide}


def _compute(equation: Any, operands: list[Any]) -> Any:
    """One element of the result of an elementwise operation; a constant if all `operands` are."""
    name = equation.primitive.name
    if all(map(_is_constant, operands)):
        with jax.ensure_compile_time_eval():
            return np.asarray(equation.primitive.bind(*map(jnp.asarray, operands), **equation.params))[()]
    if name in SIMPLIFIED:
        return SIMPLIFIED[name](*operands)
    if name == "select_n" and _is_constant(operands[0]):
        return operands[1 + int(operands[0])]
    batch = _batch(operands)
    return equation.primitive.bind(*(jnp.broadcast_to(operand, batch) for operand in operands), **equation.params)


def _reduce(combine: Callable[[Any, Any], Any], parts: Parts, axes: Sequence[int]) -> Parts:
    kept = [axis for axis in range(parts.ndim) if axis not in axes]
    shape = [parts.shape[axis] for axis in kept]
    rows = parts.transpose([*kept, *axes]).reshape([*shape, -1])
    result = np.empty(shape, object)
    for index in np.ndindex(*shape):
        total, *others = rows[index]
        for other in others:
            total = combine(total, other)
        result[index] = total
    return result


def _broadcast(parameters: Any, shape: tuple[int, ...], parts: list[Parts]) -> Parts:
    dimensions = parameters["broadcast_dimensions"]
    expanded = [parts[0].shape[dimensions.index(axis)] if axis in dimensions else 1 for axis in range(len(shape))]
    return np.broadcast_to(parts[0].reshape(expanded), shape)


def _slice(parameters: Any, shape: tuple[int, ...], parts: list[Parts]) -> Parts:
    steps = parameters["strides"] or [1] * len(shape)
    bounds = zip(parameters["start_indices"], parameters["limit_indices"], steps, strict=True)
    return parts[0][tuple(slice(*one) for one in bounds)]


def _product(parameters: Any, shape: tuple[int, ...], parts: list[Parts]) -> Parts:
    """Sums of products over the contracted axes; `shape` is (batch, left, right)."""
    (left_sum, right_sum), (left_batch, right_batch) = parameters["dimension_numbers"]

    def arranged(part: Parts, batch: Sequence[int], summed: Sequence[int]) -> Parts:
        kept = [axis for axis in range(part.ndim) if axis not in (*batch, *summed)]
        ordered = part.transpose([*batch, *kept, *summed])
        count = len(batch) + len(kept)
        return ordered.reshape([*ordered.shape[:count], -1]), ordered.shape[len(batch) : count]

    left, rows = arranged(parts[0], left_batch, left_sum)
    right, columns = arranged(parts[1], right_batch, right_sum)
    result = np.empty(shape, object)
    batches = shape[: len(left_batch)]
    for batch in np.ndindex(*batches):
        for i in np.ndindex(*rows):
            for j in np.ndindex(*columns):
                pairs = zip(left[batch + i], right[batch + j], strict=True)
                products = [_multiply(a, b) for a, b in pairs]
                total = products[0]
                for product in products[1:]:
                    total = _add(total, product)
                result[batch + i + j] = total
    return result


def _reshaped(parameters: Any, shape: tuple[int, ...], parts: list[Parts]) -> Parts:
    return parts[0].reshape(shape)


REARRANGED: dict[str, Callable[[Any, tuple[int, ...], list[Parts]], Any]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda p, shape, parts: np.concatenate(parts, axis=p["dimension"]),
    "dot_general": _product,
    "expand_dims": _reshaped,
    "reshape": _reshaped,
    "rev": lambda p, shape, parts: np.flip(parts[0], p["dimensions"]),
    "slice": _slice,
    "split": lambda p, shape, parts: np.split(parts[0], np.cumsum(p["sizes"])[:-1], axis=p["axis"]),
    "squeeze": _reshaped,
    "stack": lambda p, shape, parts: np.stack(parts, axis=p["axis"]),
    "transpose": lambda p, shape, parts: parts[0].transpose(p["permutation"]),
}
