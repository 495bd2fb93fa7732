"""The folder of a long run: one archive for each chunk that is done."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from switchfit.batch.archives import Arrays, read_arrays, write_arrays


class ChunkStore:
    """A folder with ``chunk-<first run>.npz`` files.

    Each of them also holds the fingerprint of its run and a digest of everything in it (`compute_seal`), so that a
    chunk that was cut off, edited or copied here from elsewhere is recognised.
    """

    def __init__(self, folder: Path, fingerprint: str) -> None:
        self.folder, self.fingerprint = folder, fingerprint
        folder.mkdir(parents=True, exist_ok=True)

    def load(self, chunk: range) -> Arrays | None:
        """Return the chunk's arrays; None if it is not there, or damaged, which is said in a warning.

        Raises
        ------
        ValueError
            If it is one of another run.
        """
        path = self._path(chunk)
        if not path.exists():
            return None
        arrays, reason = read_arrays(path)
        if reason:
            again = f"Runs {chunk.start} to {chunk.stop - 1} are computed again."
            warnings.warn(f"{path} is damaged: {reason}. {again}", stacklevel=2)
            return None
        if str(arrays.pop("fingerprint")) != self.fingerprint:
            raise ValueError(
                f"{self.folder} holds the results of another run (of other data, models or settings). Choose another "
                "folder, or delete this one."
            )
        # The last chunk of a shorter study has fewer runs.
        return arrays if arrays.pop("runs").tolist() == [chunk.start, chunk.stop] else None

    def save(self, chunk: range, arrays: Arrays) -> None:
        """Write a chunk, whole or not at all."""
        runs = np.array([chunk.start, chunk.stop])
        write_arrays(arrays | {"fingerprint": np.array(self.fingerprint), "runs": runs}, self._path(chunk))

    def _path(self, chunk: range) -> Path:
        return self.folder / f"chunk-{chunk.start:08d}.npz"
