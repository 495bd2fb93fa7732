"""NumPy archives of arrays that carry a digest of their content, by which damage is noticed.

Nothing in an archive is pickled. It is written whole or not at all.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.runtime.errors import get_first_line
from switchfit.runtime.files import write_atomically

Arrays = dict[str, NDArray[Any]]


def write_arrays(arrays: Arrays, path: Path) -> None:
    """Write arrays and their digest to a NumPy archive, whole or not at all.

    Parameters
    ----------
    arrays : dict of str to array
    path : Path
        An existing file is replaced.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays, seal=np.array(compute_seal(arrays)))  # type: ignore[arg-type]
    write_atomically(buffer.getvalue(), path)


def read_arrays(path: Path) -> tuple[Arrays, str]:
    """Return what `write_arrays` wrote, and what is wrong with it: empty if it is as it was written."""
    content = path.read_bytes()  # OSError names the file
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        seal = str(arrays.pop("seal", ""))
    except Exception as error:  # zipfile, zlib and NumPy raise a dozen kinds on what they cannot read
        return {}, f"it cannot be read ({get_first_line(error)})"
    return arrays, "" if seal == compute_seal(arrays) else "its content is not what was written"


def compute_seal(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return a digest of names, types, shapes and numbers.

    Parameters
    ----------
    arrays : mapping of str to array
    """
    return compute_fingerprint(*(part for name in sorted(arrays) for part in (name, np.asarray(arrays[name]))))


def compute_fingerprint(*parts: object) -> str:
    """Return a digest of numbers, strings and arrays."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(str((part.dtype, part.shape)).encode() + np.ascontiguousarray(part).tobytes())
        else:
            digest.update(repr(part).encode())
    return digest.hexdigest()
