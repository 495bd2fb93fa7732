"""Functions of `scipy.linalg.lapack`, which is imported at the first call: ``lapack.dpotrf(matrix)``.

To import it takes as long as a hundred fits, and an evaluation does not need it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def __getattr__(name: str) -> Callable[..., Any]:
    import scipy.linalg.lapack

    found: Callable[..., Any] = getattr(scipy.linalg.lapack, name)
    globals()[name] = found  # the next look-up does not come here
    return found
