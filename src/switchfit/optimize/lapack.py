"""Functions of `scipy.linalg.lapack`, which is imported at the first call: ``lapack.dpotrf(matrix)``.

To import it takes as long as a hundred fits, and an evaluation does not need it.
"""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    import scipy.linalg.lapack

    found = globals()[name] = getattr(scipy.linalg.lapack, name)
    return found
