"""A batch that is stopped ends at once."""

from __future__ import annotations

import threading
import time

import numpy as np

from switchfit.batch.chunks import run_chunks


class Endless:
    """Work whose second chunk takes very long."""

    size = 1

    def __init__(self):
        self.released = threading.Event()

    def __call__(self, runs):
        if runs.start:
            self.released.wait(60.0)
        return {"run": np.array(runs)}

    def fingerprint(self):
        return "endless"


def test_a_batch_that_is_stopped_does_not_wait_for_the_chunk_under_way():
    work = Endless()
    began = time.monotonic()
    runs, _ = run_chunks(work, 2, progress=lambda done, total: True)
    waited = time.monotonic() - began
    work.released.set()
    assert runs.tolist() == [0]
    assert waited < 30.0, "as long as the chunk"
