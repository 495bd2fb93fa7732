"""Operations that only move entries of traced arrays: reshape, slice, pad and so on. They emit nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from switchfit.engine.native.tracing.entries import Parameters, TracedArray
from switchfit.problem.jaxprs import SELECTIONS as SELECTIONS


def broadcast_in_dim(params: Parameters, a: TracedArray, *_: TracedArray) -> TracedArray:
    """Return an array in a larger shape, repeated along the new axes."""
    others = [k for k in range(len(params["shape"])) if k not in params["broadcast_dimensions"]]
    return np.broadcast_to(np.expand_dims(a, others), params["shape"])


def _pad(params: Parameters, a: TracedArray, value: TracedArray) -> TracedArray:
    """Insert entries between and around those of an array; a negative count at an end removes entries."""
    shape, inside, places = [], [], []
    for n, (low, high, between) in zip(a.shape, params["padding_config"], strict=True):
        shape.append(low + n + max(n - 1, 0) * between + high)
        place = low + np.arange(n) * (between + 1)
        inside.append((place >= 0) & (place < shape[-1]))
        places.append(place[inside[-1]])
    result = np.empty(shape, dtype=object if object in (a.dtype, value.dtype) else a.dtype)
    result[...] = value.item()
    result[np.ix_(*places)] = a[np.ix_(*inside)]
    return result


MOVING_OPERATIONS: dict[str, Callable[..., Any]] = {
    # NumPy moves objects as it moves numbers: these operations cost nothing at run time.
    **{name: lambda params, a, *_, move=move: move(a, params) for name, move in SELECTIONS.items()},
    "broadcast_in_dim": broadcast_in_dim,
    "concatenate": lambda params, *a: np.concatenate(a, axis=params["dimension"]),
    "pad": _pad,
    "rev": lambda params, a: np.flip(a, params["dimensions"]),
    "tile": lambda params, a: np.tile(a, params["reps"]),
    "split": lambda params, a: np.split(a, np.cumsum(params["sizes"])[:-1], axis=params["axis"]),
    "stack": lambda params, *a: np.stack(a, axis=params["axis"]),
    "unstack": lambda params, a: list(np.moveaxis(a, params["axis"], 0)),
    "copy": lambda params, a: a,
    "stop_gradient": lambda params, a: a,
    "optimization_barrier": lambda params, *a: a,
}
"""Operations that only move entries."""
