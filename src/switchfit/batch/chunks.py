"""Long runs in chunks: on all cores or on a Dask cluster, with progress, and with what is done kept on disk.

`run_chunks` knows nothing of fits. Its *work* is called with a range of runs and returns arrays with one entry a run; a
chunk depends on nothing but its range, so it does not matter where, when and how often it is computed.

How many cores there are.
"""

from __future__ import annotations

import functools
import hashlib
import io
import os
import warnings
from collections.abc import Generator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.runtime.errors import get_first_line
from switchfit.runtime.files import write_atomically
from switchfit.runtime.progress import Progress

Arrays = dict[str, NDArray[Any]]

RETRIES = 3
"""Times a chunk is tried again on a Dask cluster after an error."""

MANY = 8
"""Chunks a core from which there is one thread more than cores."""


def count_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_chunks(
    work: Any, count: int, *, client: Any = None, folder: Path | None = None, progress: Progress = lambda *done: None
) -> tuple[NDArray[np.intp], Arrays]:
    """Do all runs 0 .. count - 1, in chunks.

    Parameters
    ----------
    work : object
        Called with the range of runs of a chunk, it returns arrays with one entry for each. It has the number of runs
        in a chunk, `size`, and ``fingerprint()``, a digest that changes with everything that a result depends on. For a
        Dask cluster it must survive pickling.
    count : int
    client : dask.distributed.Client, optional
        Where the chunks are computed; in threads of this process, one a core, if left out. A chunk whose worker is
        lost is computed again by another one.
    folder : path, optional
        Each chunk is written there when it is done, and chunks that are found there are not computed again. The runs of
        a damaged file, which is said in a warning, are.
    progress : callable, optional
        ``progress(done, total)``; a true return value stops, as Ctrl-C does.

    Returns
    -------
    runs : (R,) int
        Which runs are done, ascending: all, unless it was stopped.
    arrays : dict of str -> (R, ...) array

    Raises
    ------
    ValueError
        If the folder holds the chunks of something else.
    """
    chunks = [range(first, min(first + work.size, count)) for first in range(0, count, work.size)]
    store = None if folder is None else _Store(folder, work.fingerprint())
    stored = {chunk: store.load(chunk) if store else None for chunk in chunks}
    results = {chunk: arrays for chunk, arrays in stored.items() if arrays is not None}
    missing = [chunk for chunk in chunks if chunk not in results]
    done = count - sum(map(len, missing))
    stopped = done > 0 and progress(done, count)
    if missing and not stopped:
        computed = _run_in_threads(work, missing) if client is None else _run_on_cluster(work, missing, client)
        with closing(computed), suppress(KeyboardInterrupt):
            for chunk, arrays in computed:
                results[chunk] = arrays
                if store:
                    store.save(chunk, arrays)
                done += len(chunk)
                if progress(done, count):
                    break
    if not results:
        raise KeyboardInterrupt
    finished = [chunk for chunk in chunks if chunk in results]
    runs = np.concatenate([np.asarray(chunk) for chunk in finished])
    return runs, {name: np.concatenate([results[chunk][name] for chunk in finished]) for name in results[finished[0]]}


def _run_in_threads(work: Any, chunks: list[range]) -> Generator[tuple[range, Arrays]]:
    """Yield chunks as they are done by threads; JAX's programs run outside Python's lock."""
    cores = count_cores()
    # One thread more where there are many chunks: it works while another one waits for the lock.
    pool = ThreadPoolExecutor(cores + (len(chunks) >= MANY * cores))
    calls = {pool.submit(work, chunk): chunk for chunk in chunks}
    try:
        for future in as_completed(calls):
            yield calls[future], future.result()
    finally:
        # Stopped early, a chunk under way may take long: it ends by itself, and nobody waits for it.
        pool.shutdown(wait=False, cancel_futures=True)


def _run_on_cluster(work: Any, chunks: list[range], client: Any) -> Generator[tuple[range, Arrays]]:
    """Yield chunks as they are done by the workers of a Dask cluster.

    The work travels as bytes that are themselves the result of a task, so that they outlive the workers that hold
    them; a worker unpickles them once, or it would compile the model's functions anew for every chunk.
    """
    import cloudpickle
    import distributed

    blob = cloudpickle.dumps(work)
    shared, each = client.submit(_receive, blob, pure=False), {"pure": False, "retries": RETRIES}
    futures = {client.submit(_run_remotely, shared, chunk, **each): chunk for chunk in chunks}
    try:
        for future in distributed.as_completed(list(futures)):
            yield futures[future], future.result()
    finally:
        client.cancel([*futures, shared])


def _receive(blob: bytes) -> bytes:
    return blob


@functools.lru_cache(maxsize=4)
def _unpickle(blob: bytes) -> Any:
    import cloudpickle

    return cloudpickle.loads(blob)


def _run_remotely(blob: bytes, chunk: range) -> Arrays:
    return _unpickle(blob)(chunk)


class _Store:
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


def compute_fingerprint(*parts: Any) -> str:
    """Return a digest of numbers, strings and arrays."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(str((part.dtype, part.shape)).encode() + np.ascontiguousarray(part).tobytes())
        else:
            digest.update(repr(part).encode())
    return digest.hexdigest()
