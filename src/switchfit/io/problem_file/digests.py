"""The files that a problem file depends on, and their hashes."""

from __future__ import annotations

import hashlib
from modulefinder import ModuleFinder
from pathlib import Path

from switchfit.io.logs.files import find_logs
from switchfit.io.problem_file.tables import Contents
from switchfit.io.provenance import FileDigest, make_relative
from switchfit.io.user_files import replace_files


def list_files(folder: Path, contents: Contents) -> list[Path]:
    """Return the files that a problem file names: of patterns and bags, Python files and what they import."""
    names: list[str] = []

    def note(name: str) -> str:
        names.append(name)
        return name

    # The walk over all names of files, for its side effect: what it returns is not needed.
    replace_files(contents.model_dump(exclude_none=True), note)
    files: list[Path] = []
    for name in names:
        if name.endswith(".py"):
            # Modules beside the file alone: with the path of the interpreter it would list all of JAX.
            finder = ModuleFinder([str((folder / name).parent)])
            finder.run_script(str(folder / name))
            found = (getattr(module, "__file__", None) for module in finder.modules.values())
            files += [Path(file) for file in found if file is not None]
        else:
            for path in (folder / log for log in find_logs(folder, name) or [name]):
                # The folder of a bag of ROS 2 is one log, of several files.
                files += sorted(path.rglob("*")) if path.is_dir() else [path]
    return list(dict.fromkeys(files))


def digest_file(folder: Path, path: Path) -> FileDigest:
    """Return the digest of a file, named by its path from a folder; one that cannot be read has none.

    Parameters
    ----------
    folder, path : Path
    """
    name = make_relative(path, folder)
    try:
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            return FileDigest(name, file.tell(), sha256)
    except OSError:
        return FileDigest(name, 0, "")
