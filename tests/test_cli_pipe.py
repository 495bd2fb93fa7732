"""The command line when what reads its output stops reading."""

import subprocess
import sys
from pathlib import Path

import pytest

TOSS = Path(__file__).parent.parent / "examples" / "toss" / "problem.toml"
PROGRAM = "from switchfit.cli import main; main()"


@pytest.mark.parametrize("stream", ["stdout", pytest.param("stderr", marks=pytest.mark.slow)])
def test_a_reader_that_is_gone_ends_nothing(stream, tmp_path, quick_processes):
    """As `switchfit ... | head`: no traceback, all files, and the exit code as without the pipe."""
    command = [sys.executable, "-c", PROGRAM, "fit", str(TOSS), "--out", str(tmp_path), "--no-figures"]
    other = "stderr" if stream == "stdout" else "stdout"
    with subprocess.Popen(command, **{stream: subprocess.PIPE, other: subprocess.PIPE}, text=True) as process:
        getattr(process, stream).close()  # before anything is written
        said = getattr(process, other).read()
        assert process.wait(timeout=120) == 0
    assert "Broken pipe" not in said
    assert "Traceback" not in said
    assert {"report.txt", "estimate.json"} <= {path.name for path in tmp_path.iterdir()}
    assert ("written to" in said) == (other == "stderr")
