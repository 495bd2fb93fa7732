"""Chunks: runs that were stopped go on, folders of other runs are refused, a cluster loses a worker."""

import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest

import switchfit as sf
from support.heated_rooms import TRUTH, room
from support.models import decay
from switchfit.batch.chunks import run_chunks
from switchfit.batch.layout import CHUNK

OTHER = sf.HybridSystem({"on": lambda t, x, p: 2.0 - 2.0 * p["k"] * x, "off": decay}, [0.2])


def test_a_run_that_was_stopped_goes_on_where_it_was(tmp_path):
    settings, seen = {"theta": TRUTH, "seed": 5}, []
    kept = settings | {"folder": tmp_path / "study"}
    partial = sf.monte_carlo(room(), 4 * CHUNK, **kept, callback=lambda done, total: seen.append(done) or True)
    assert len(partial) < 4 * CHUNK
    assert "stopped, " in str(partial)
    assert partial.verdict.reasons[-1].kind == "stopped"
    done = len(list(kept["folder"].iterdir())) * CHUNK
    whole = sf.monte_carlo(room(), 4 * CHUNK, **kept, callback=lambda done, total: seen.append(done))
    assert (*seen[:2], seen[-1]) == (CHUNK, done, 4 * CHUNK)
    np.testing.assert_array_equal(whole.theta, sf.monte_carlo(room(), 4 * CHUNK, **settings).theta)
    np.testing.assert_array_equal(whole.runs, np.arange(4 * CHUNK))


def test_a_folder_of_another_run_is_refused(tmp_path):
    sf.multistart(room(), 2, folder=tmp_path)
    for problem, seed in ((room(), 1), (replace(room(), system=OTHER), 0)):
        with pytest.raises(ValueError, match="holds the results of another run"):
            sf.multistart(problem, 2, folder=tmp_path, seed=seed)


def test_ctrl_c_returns_what_is_done(tmp_path):
    def work(runs):
        if runs.start == 4:
            time.sleep(0.2)  # the others are done by then
            raise KeyboardInterrupt
        return {"value": np.arange(runs.start, runs.stop)}

    work.size, work.fingerprint = 2, lambda: "interrupted"
    runs, arrays = run_chunks(work, 6, folder=tmp_path / "x")
    assert set(runs) <= {0, 1, 2, 3}
    np.testing.assert_array_equal(arrays["value"], runs)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_in_the_middle(tmp_path, quick_processes):
    """Two worker processes, one of which is killed after the first chunk: nothing is missing, nothing differs."""
    distributed = pytest.importorskip("distributed")
    alone = sf.monte_carlo(room(), 6 * CHUNK, theta=TRUTH, seed=7)
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, local_directory=str(tmp_path)
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        workers = client.run(os.getpid)
        assert len(set(workers.values())) == 2
        killed = []

        def progress(done, total):
            if not killed:
                killed.append(next(iter(workers.values())))
                os.kill(killed[0], signal.SIGKILL)

        study = sf.monte_carlo(room(), 6 * CHUNK, theta=TRUTH, seed=7, client=client, callback=progress)
    assert killed
    assert len(study) == 6 * CHUNK
    assert study.success.all()
    np.testing.assert_allclose(study.theta, alone.theta, rtol=0, atol=1e-12)
