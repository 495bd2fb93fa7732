"""Whether a saved estimate is there. This imports nothing else, so that commands say at once that it is not."""

from __future__ import annotations

import os
from pathlib import Path

from switchfit.runtime.errors import InputError


def check_saved(path: Path) -> None:
    """Raise InputError unless there is a file.

    Parameters
    ----------
    path : Path
    """
    if os.path.isdir(path):
        raise InputError(f"{path} is a folder; name the estimate.json in it.")
    try:
        path.stat()
    except FileNotFoundError as error:
        raise InputError(f"There is no saved estimate {path}; check the name and the folder.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
