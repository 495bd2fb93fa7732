"""Functions of `scipy.special`, which is imported at the first call: ``special.ndtri(0.975)``.

To import it takes as long as to fit, and much of what people do with a model does not need it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def __getattr__(name: str) -> Callable[..., Any]:
    import scipy.special

    found: Callable[..., Any] = getattr(scipy.special, name)
    globals()[name] = found  # the next look-up does not come here
    return found
