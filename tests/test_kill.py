"""A study killed at random moments: its files are whole, and run again it ends as if nothing had happened."""

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from switchfit.runtime.cache import read_code

ROOT = Path(__file__).parent.parent
KILLS = 20

PROGRAM = """
import sys
import numpy as np
import switchfit as sf
from switchfit.batch import study

study.choose_chunk_size = lambda: 2  # many chunks, so that many moments are those of a write
system = sf.HybridSystem({"up": lambda t, x, p: p["v"] + 0 * x, "rest": lambda t, x, p: 0 * x}, [0.0])
times = np.linspace(0.05, 1.95, 20)
values = 3.0 * np.minimum(times, 1.23) + 0.1 * np.random.default_rng(0).normal(size=20)
run = sf.Experiment(sf.Measurements(times, values, sigma=0.1), ("up", "rest"), (1.0,), 0.0, 2.0)
print("begun", flush=True)
found = sf.bootstrap(sf.estimate(sf.Problem(system, run, {"v": 2.0})), 24, folder=sys.argv[1])
print(found.theta.tobytes().hex())
"""


@pytest.mark.slow
def test_killed_at_random_moments(tmp_path):
    environment = {"PYTHONPATH": str(ROOT / "src"), "SWITCHFIT_CACHE": str(tmp_path / "cache"), "OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}

    def start(folder):
        command = [sys.executable, "-c", PROGRAM, str(folder)]
        process = subprocess.Popen(command, env=os.environ | environment, **pipes)
        assert process.stdout.readline() == "begun\n", process.communicate()[1]
        return process

    def end(process):
        output, errors = process.communicate(timeout=900)
        assert process.returncode == 0, errors
        assert "damaged" not in errors
        assert "lost" not in errors
        return output

    def contents(folder):
        return {path.name: path.read_bytes() for path in folder.iterdir() if not path.name.startswith(".switchfit-")}

    expected = end(start(tmp_path / "first"))
    files, began = contents(tmp_path / "first"), time.monotonic()
    assert end(start(tmp_path / "again")) == expected
    duration = time.monotonic() - began
    rng = random.Random(0)
    kills = rounds = 0
    while kills < KILLS:
        folder = tmp_path / f"round{rounds}"
        rounds += 1
        for _ in range(rng.choice([1, 2, 4])):  # so often before it may end
            process = start(folder)
            try:
                process.wait(rng.uniform(0.0, duration))
            except subprocess.TimeoutExpired:
                process.kill()
                kills += 1
            process.communicate()
            for path in folder.glob("*.npz"):
                with np.load(path) as file:
                    assert [file[name] for name in file.files]  # an array that is cut off raises an error
        assert end(start(folder)) == expected
        assert contents(folder) == files
    assert all(read_code(path) for path in (tmp_path / "cache").iterdir() if not path.name.startswith(".switchfit-"))
