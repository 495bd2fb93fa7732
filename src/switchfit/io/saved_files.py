"""Whether a saved estimate is there. This imports nothing else, so that commands say at once that it is not."""

from __future__ import annotations

from pathlib import Path

from switchfit.runtime.files import explain_read_errors


def check_saved(path: Path) -> None:
    """Raise InputError unless there is a file that can be read.

    Parameters
    ----------
    path : Path
    """
    with explain_read_errors(path, "saved estimate", "the estimate.json"):
        path.open("rb").close()
