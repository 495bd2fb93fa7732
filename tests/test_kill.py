"""Processes killed at random moments: what they wrote is whole, and run again they end as if nothing had happened."""

from __future__ import annotations

import json
import os
import random
import re
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
from pathlib import Path
import numpy as np
import switchfit as sf
from switchfit import cli
from switchfit.batch import study
from switchfit import paper
from switchfit.paper import noise

kind, folder, toss = sys.argv[1], Path(sys.argv[2]), sys.argv[3]
study.choose_chunk_size = lambda: 2  # many chunks, so that many moments are those of a write
noise.QUICK_LEVELS, noise.QUICK_RUNS = (0.0, 0.25), 6
paper.PARTS = {"lti": paper.PARTS["lti"], "noise": paper.PARTS["noise"]}

system = sf.HybridSystem({"up": lambda t, x, p: p["v"] + 0 * x, "rest": lambda t, x, p: 0 * x}, [0.0])
times = np.linspace(0.05, 1.95, 20)


def problem(seed=0):
    values = 3.0 * np.minimum(times, 1.23) + 0.1 * np.random.default_rng(seed).normal(size=20)
    run = sf.Experiment(sf.Measurements(times, values, sigma=0.1), ("up", "rest"), (1.0,), 0.0, 2.0)
    return sf.Problem(system, run, {"v": 2.0})


print("begun", flush=True)
if kind == "fit":
    sys.argv = ["switchfit", "fit", toss, "--out", str(folder)]
    cli.main()
elif kind == "paper":
    sys.argv = ["switchfit", "paper", "--quick", "--out", str(folder)]
    cli.main()
elif kind == "monte_carlo":
    found = sf.monte_carlo(problem(), 24, theta=[1.2, 3.0], folder=folder)
elif kind == "estimate_many":
    found = sf.estimate_many([problem(seed) for seed in range(24)], folder=folder)
elif kind == "bootstrap":
    found = sf.bootstrap(sf.estimate(problem()), 24, folder=folder)
print(found.theta.tobytes().hex())
"""

TIMES = {
    ".json": (rb'"seconds": [0-9.e-]+', b""),
    ".txt": (rb"[0-9.e-]+\s+s in all|\([0-9.e-]+\s+s\)|evaluations?, [0-9.e-]+ s|\s+", b""),
    ".html": (rb"[0-9.e-]+ s in all|\([0-9.e-]+ s\)|>[0-9.e-]+</td", b""),
    ".md": (rb"[0-9]+ s in all", b""),
    ".pdf": (rb"/CreationDate \(.*?\)", b""),
}
"""Times and dates in files of a kind."""


def contents(folder: Path) -> dict[str, bytes]:
    """All files but the temporary ones that a kill left, without the times that were measured."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.startswith(".switchfit-"):
            pattern, nothing = TIMES.get(path.suffix, (rb"$.", b""))
            found[str(path.relative_to(folder))] = re.sub(pattern, nothing, path.read_bytes())
    return found


def check_whole(folder: Path) -> None:
    """Every file but temporary ones can be read to its end."""
    for path in folder.rglob("*"):
        if path.suffix == ".json":
            json.loads(path.read_text(encoding="utf-8"))
        elif path.suffix == ".npz":
            with np.load(path) as file:
                assert [file[name] for name in file.files]  # an array that is cut off raises an error
        elif path.suffix == ".png":
            assert path.read_bytes().endswith(b"IEND\xaeB`\x82")
        elif path.suffix == ".pdf":
            assert path.read_bytes().rstrip().endswith(b"%%EOF")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fit", "monte_carlo", "estimate_many", "bootstrap", "paper"])
def test_killed_at_random_moments(kind, tmp_path):
    toss = ROOT / "examples" / "toss" / "problem.toml"
    environment = os.environ | {
        "PYTHONPATH": str(ROOT / "src"), "SWITCHFIT_CACHE": str(tmp_path / "cache"), "OMP_NUM_THREADS": "1",
    }  # fmt: skip

    def start(folder: Path) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, kind, str(folder), str(toss)],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert process.stdout.readline() == "begun\n", process.communicate()[1]
        return process

    def end(process: subprocess.Popen[str]) -> str:
        output, errors = process.communicate(timeout=900)
        assert process.returncode == 0, errors
        assert "damaged" not in errors
        assert "lost" not in errors
        return "" if kind in ("fit", "paper") else output

    undisturbed = start(tmp_path / "first")
    end(undisturbed)
    began = start(tmp_path / "undisturbed"), time.monotonic()
    expected = end(began[0])
    duration = time.monotonic() - began[1]
    files = contents(tmp_path / "undisturbed")
    assert contents(tmp_path / "first") == files

    rng = random.Random(kind)
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
            check_whole(folder)
        assert end(start(folder)) == expected
        assert contents(folder) == files
    assert all(read_code(path) for path in (tmp_path / "cache").iterdir() if not path.name.startswith(".switchfit-"))
