"""Long runs in chunks: on all cores or on a Dask cluster, with progress, and with what is done kept on disk.

`run_chunks` knows nothing of fits. Its *work* is called with a range of runs and returns arrays with one entry a run; a
chunk depends on nothing but its range, so it does not matter where, when and how often it is computed.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from switchfit.batch.archives import Arrays
from switchfit.batch.chunk_store import ChunkStore
from switchfit.runtime.progress import Progress

MOST_RETRIES = 3
"""Times a chunk is tried again on a Dask cluster after an error."""

CHUNKS_FOR_ONE_MORE_THREAD = 8
"""Chunks a core from which there is one thread more than cores."""


class Work(Protocol):
    """What `run_chunks` does: runs, by their numbers; for a Dask cluster it must survive pickling."""

    @property
    def size(self) -> int:
        """Number of runs in a chunk."""

    def __call__(self, runs: range) -> Arrays:
        """Return arrays with one entry for each of some runs."""

    def fingerprint(self) -> str:
        """Return a digest that changes with everything that a result depends on."""


def _count_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_chunks(
    work: Work, count: int, *, client: Any = None, folder: Path | None = None, progress: Progress = lambda *done: None
) -> tuple[NDArray[np.intp], Arrays]:
    """Do all runs 0 .. count - 1, in chunks.

    Parameters
    ----------
    work : Work
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
    # The cut does not depend on the cores: with the same folder another machine finds the same chunks.
    chunks = [range(first, min(first + work.size, count)) for first in range(0, count, work.size)]
    # The fingerprint is computed once, not for each chunk: it digests all data.
    store = None if folder is None else ChunkStore(folder, work.fingerprint())
    stored = {chunk: store.load(chunk) if store else None for chunk in chunks}
    results = {chunk: arrays for chunk, arrays in stored.items() if arrays is not None}
    missing = [chunk for chunk in chunks if chunk not in results]
    done = count - sum(map(len, missing))
    # What was found on disk counts for the bar at once.
    stopped = done > 0 and progress(done, count)
    if missing and not stopped:
        computed = _run_in_threads(work, missing) if client is None else _run_on_cluster(work, missing, client)
        # Ctrl-C ends the loop, not the run: what is done is returned. `closing` cancels what has not begun.
        with closing(computed), suppress(KeyboardInterrupt):
            for chunk, arrays in computed:
                results[chunk] = arrays
                if store:
                    store.save(chunk, arrays)
                done += len(chunk)
                if progress(done, count):
                    break
    # Nothing is done that could be returned.
    if not results:
        raise KeyboardInterrupt
    finished = [chunk for chunk in chunks if chunk in results]
    # In the order of `chunks`, not of their ends: results do not depend on how threads were scheduled.
    runs = np.concatenate([np.asarray(chunk) for chunk in finished])
    return runs, {name: np.concatenate([results[chunk][name] for chunk in finished]) for name in results[finished[0]]}


def _run_in_threads(work: Work, chunks: list[range]) -> Generator[tuple[range, Arrays]]:
    """Yield chunks as they are done by threads; JAX's programs run outside Python's lock."""
    cores = _count_cores()
    # One thread more where there are many chunks: it works while another one waits for the lock.
    pool = ThreadPoolExecutor(cores + (len(chunks) >= CHUNKS_FOR_ONE_MORE_THREAD * cores))
    calls = {pool.submit(work, chunk): chunk for chunk in chunks}
    try:
        for future in as_completed(calls):
            yield calls[future], future.result()
    finally:
        # Stopped early, a chunk under way may take long: it ends by itself, and nobody waits for it.
        pool.shutdown(wait=False, cancel_futures=True)


def _run_on_cluster(work: Work, chunks: list[range], client: Any) -> Generator[tuple[range, Arrays]]:
    """Yield chunks as they are done by the workers of a Dask cluster.

    The work travels as bytes that are themselves the result of a task, so that they outlive the workers that hold
    them; a worker unpickles them once, or it would compile the model's functions anew for every chunk.
    """
    import cloudpickle
    import distributed

    # Once for all chunks; a study may hold many megabytes of data.
    blob = cloudpickle.dumps(work)
    # pure=False: Dask would otherwise name tasks by a hash of their arguments, and return results of an earlier run.
    shared, each = client.submit(_receive, blob, pure=False), {"pure": False, "retries": MOST_RETRIES}
    futures = {client.submit(_run_remotely, shared, chunk, **each): chunk for chunk in chunks}
    try:
        for future in distributed.as_completed(list(futures)):
            yield futures[future], future.result()
    finally:
        client.cancel([*futures, shared])


def _receive(blob: bytes) -> bytes:
    return blob


@functools.lru_cache(maxsize=4)
def _unpickle(blob: bytes) -> Work:
    import cloudpickle

    work: Work = cloudpickle.loads(blob)
    return work


def _run_remotely(blob: bytes, chunk: range) -> Arrays:
    return _unpickle(blob)(chunk)
