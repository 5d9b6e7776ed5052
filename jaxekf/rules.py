"""Operations on arrays of numbers: rearrangements, and sums and products written out."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from jax import lax

from jaxekf.graph import ADD, MULTIPLY, Arithmetic, Numbers, Written, constants

Rule = Callable[[Arithmetic, dict[str, Any], list[Numbers]], list[Numbers] | None]


def _moved(move: Callable[[dict[str, Any], Numbers], Numbers]) -> Rule:
    """An operation on one operand that only rearranges."""
    return lambda arithmetic, params, operands: [move(params, operands[0])]


def _broadcast(params: dict[str, Any], numbers: Numbers) -> Numbers:
    shape = [1] * len(params["shape"])
    for axis, place in enumerate(params["broadcast_dimensions"]):
        shape[place] = numbers.shape[axis]
    return np.broadcast_to(numbers.reshape(shape), params["shape"])


def _slice(params: dict[str, Any], numbers: Numbers) -> Numbers:
    strides = params["strides"] or (1,) * numbers.ndim
    starts, limits = params["start_indices"], params["limit_indices"]
    return numbers[tuple(slice(*part) for part in zip(starts, limits, strides, strict=True))]


def _concatenate(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers]:
    return [np.concatenate(operands, params["dimension"])]


def _stack(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers]:
    return [np.stack(operands, params["axis"])]


def _unstack(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers]:
    whole = np.moveaxis(operands[0], params["axis"], 0)
    return [whole[i, ...] for i in range(whole.shape[0])]


def _split(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers]:
    return list(np.split(operands[0], np.cumsum(params["sizes"])[:-1], params["axis"]))


def _pad(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers] | None:
    numbers, filling = operands
    if any(inner for _, _, inner in params["padding_config"]):
        return None
    for axis, (low, high, _) in enumerate(params["padding_config"]):
        cut = slice(max(-low, 0), numbers.shape[axis] - max(-high, 0))
        numbers = numbers[(slice(None),) * axis + (cut,)]
        pieces = []
        for count in (max(low, 0), max(high, 0)):
            shape = [*numbers.shape]
            shape[axis] = count
            piece = np.empty(shape, object)
            piece[...] = filling[()]
            pieces.append(piece)
        numbers = np.concatenate([pieces[0], numbers, pieces[1]], axis)
    return [numbers]


def _reduce(primitive: Any) -> Rule:
    def rule(
        arithmetic: Arithmetic, params: dict[str, Any], operands: list[Numbers]
    ) -> list[Numbers] | None:
        (numbers,) = operands
        axes = tuple(params["axes"])
        if params.get("out_sharding") is not None or not numbers.size:
            return None
        rest = [a for a in range(numbers.ndim) if a not in axes]
        flat = numbers.transpose([*axes, *rest])
        flat = flat.reshape(-1, *flat.shape[len(axes) :])
        found = np.empty(flat.shape[1:], object)
        for index in np.ndindex(found.shape):
            terms = [flat[(k, *index)] for k in range(flat.shape[0])]
            found[index] = functools.reduce(functools.partial(arithmetic, primitive), terms)
        return [found]

    return rule


def _dot_general(
    arithmetic: Arithmetic, params: dict[str, Any], operands: list[Numbers]
) -> list[Numbers]:
    left, right = operands
    (left_sum, right_sum), (left_batch, right_batch) = params["dimension_numbers"]
    left_free = [a for a in range(left.ndim) if a not in (*left_sum, *left_batch)]
    right_free = [a for a in range(right.ndim) if a not in (*right_sum, *right_batch)]
    sums = [range(left.shape[a]) for a in left_sum]
    batch = [range(left.shape[a]) for a in left_batch]
    left = left.transpose([*left_sum, *left_batch, *left_free])
    right = right.transpose([*right_sum, *right_batch, *right_free])
    inner = len(sums) + len(batch)
    found = np.empty(
        [len(r) for r in batch] + [*left.shape[inner:]] + [*right.shape[inner:]], object
    )
    for b in itertools.product(*batch):
        for i in np.ndindex(left.shape[inner:]):
            for j in np.ndindex(right.shape[inner:]):
                terms = [
                    arithmetic(MULTIPLY, left[(*k, *b, *i)], right[(*k, *b, *j)])
                    for k in itertools.product(*sums)
                ]
                add = functools.partial(arithmetic, ADD)
                found[(*b, *i, *j)] = functools.reduce(add, terms)
    return [found]


def _iota(arithmetic: Any, params: dict[str, Any], operands: list[Numbers]) -> list[Numbers]:
    shape, axis = params["shape"], params["dimension"]
    line = np.arange(shape[axis], dtype=params["dtype"])
    whole = np.broadcast_to(
        line.reshape([-1 if a == axis else 1 for a in range(len(shape))]), shape
    )
    return [constants(whole)]


RULES: dict[str, Rule] = {
    "broadcast_in_dim": _moved(_broadcast),
    "concatenate": _concatenate,
    "dot_general": _dot_general,
    "iota": _iota,
    "pad": _pad,
    "reduce_and": _reduce(Written("and", lax.bitwise_and)),
    "reduce_max": _reduce(Written("max", lax.max)),
    "reduce_min": _reduce(Written("min", lax.min)),
    "reduce_or": _reduce(Written("or", lax.bitwise_or)),
    "reduce_sum": _reduce(ADD),
    "reshape": _moved(lambda params, numbers: numbers.reshape(params["new_sizes"])),
    "rev": _moved(lambda params, numbers: np.flip(numbers, params["dimensions"])),
    "slice": _moved(_slice),
    "split": _split,
    "squeeze": _moved(lambda params, numbers: np.squeeze(numbers, tuple(params["dimensions"]))),
    "stack": _stack,
    "transpose": _moved(lambda params, numbers: numbers.transpose(params["permutation"])),
    "unstack": _unstack,
}
