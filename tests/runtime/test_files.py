"""Files that survive what happens to files: kills, full disks, damage, other processes, other users."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import numpy as np
import pytest

from switchfit.batch.chunks import run_chunks
from switchfit.runtime.cache import get_usable_folder, read_code, write_code
from switchfit.runtime.files import write_atomically

# --- one writer -------------------------------------------------------------------------------------------------------


def test_the_old_file_is_there_until_the_new_one_is_whole(tmp_path, monkeypatch):
    """So a process that is killed leaves it; and another process that writes leaves the file that is not yet whole."""
    path, sync = tmp_path / "a.json", os.fsync
    path.write_text("old")

    def look_around(handle):
        monkeypatch.setattr(os, "fsync", sync)
        write_atomically("other", tmp_path / "b.json")
        assert len(list(tmp_path.iterdir())) == 3
        assert path.read_text() == "old"

    monkeypatch.setattr(os, "fsync", look_around)
    write_atomically("new", path)
    assert path.read_text() == "new"
    assert len(list(tmp_path.iterdir())) == 2


def test_links_devices_and_permissions(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "a")
    write_atomically("text", tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    (tmp_path / "usual").touch()
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "usual").stat().st_mode
    write_atomically("gone", Path(os.devnull))
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)


@pytest.mark.parametrize("write", [write_atomically, lambda content, path: write_code(path, content)])
def test_a_disk_that_is_full(write, tmp_path, monkeypatch):
    """The error names the file, which is as it was; the cache goes without, and nothing is left in either case."""

    def full(*given):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (tmp_path / "a").write_text("old")
    monkeypatch.setattr(Path, "replace", full)
    monkeypatch.setattr(os, "fsync", full)
    if write is write_atomically:
        with pytest.raises(OSError, match=f"No space left on device: '{tmp_path / 'a'}'"):
            write(b"new", tmp_path / "a")
    else:
        write(b"new", tmp_path / "a")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]


# --- chunks -----------------------------------------------------------------------------------------------------------


class Squares:
    """Work whose runs are known: numbers, an array a run, and text."""

    size = 3

    def __init__(self, name="squares"):
        self.name = name
        self.computed = []

    def __call__(self, runs):
        self.computed.append(runs.start)
        k = np.asarray(runs)
        return {"square": k**2.0, "row": np.outer(k, [1.0, 2.0]), "text": np.array([f"run {i}" for i in runs])}

    def fingerprint(self):
        return self.name


@pytest.fixture
def study(tmp_path):
    """A folder with the chunks of 10 runs, and what they hold."""
    _, arrays = run_chunks(Squares(), 10, folder=tmp_path / "study")
    return tmp_path / "study", arrays


def again(folder, arrays, computed):
    """Run once more: the same arrays, with just these chunks computed; and once more without anything to do."""
    for expected in (computed, []):
        work = Squares()
        _, found = run_chunks(work, 10, folder=folder)
        assert sorted(work.computed) == expected
        assert found.keys() == arrays.keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array)


def change_arrays(path, **changes):
    """Other arrays in a valid file; None drops one."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files} | changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


DAMAGES = {
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:-200]),
    "objects": lambda path: change_arrays(path, text=np.array(["a", 1, None], dtype=object)),
    "no seal": lambda path: change_arrays(path, seal=None),
    "a field missing": lambda path: change_arrays(path, row=None),
    "other numbers": lambda path: change_arrays(path, square=np.array([9.0, 16.0, 25.0 + 1e-9])),
    "of another run": lambda path: change_arrays(path, fingerprint=np.array("cubes")),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_chunk_is_named_and_computed_again(damage, study):
    folder, arrays = study
    path = folder / "chunk-00000003.npz"
    DAMAGES[damage](path)
    with pytest.warns(UserWarning, match=r"chunk-00000003\.npz is damaged: .*Runs 3 to 5 are computed") as said:
        again(folder, arrays, [3])
    assert len(said) == 1
    assert str(path) in str(said[0].message)


def test_a_chunk_that_was_copied_to_the_name_of_another_is_computed_again(study):
    folder, arrays = study
    (folder / "chunk-00000003.npz").write_bytes((folder / "chunk-00000006.npz").read_bytes())
    again(folder, arrays, [3])


def test_chunks_of_a_study_that_goes_on_further(study):
    folder, arrays = study
    work = Squares()
    _, found = run_chunks(work, 12, folder=folder)
    assert work.computed == [9]  # the last one, which was shorter
    np.testing.assert_array_equal(found["square"][:10], arrays["square"])


def test_a_folder_of_another_run_is_refused_and_not_touched(study):
    folder = study[0]
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(ValueError, match="holds the results of another run"):
        run_chunks(Squares("cubes"), 10, folder=folder)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


# --- the cache --------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="a system without users")
def test_the_cache_is_for_the_user_alone(tmp_path, monkeypatch):
    folder = tmp_path / "a" / "cache"
    monkeypatch.setenv("SWITCHFIT_CACHE", str(folder))
    before = os.umask(0)
    try:
        assert get_usable_folder() == folder
    finally:
        os.umask(before)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    path = folder / "native-1"
    write_code(path, b"code")
    assert read_code(path) == b"code"
    path.chmod(0o666)
    assert read_code(path) is None, "others may have written it"
    path.chmod(0o600)
    path.write_bytes(path.read_bytes()[:-1])
    assert read_code(path) is None, "damaged"
    owner = folder.stat().st_uid
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    with pytest.warns(UserWarning, match=f"it belongs to the user with the number {owner}, not to you"):
        assert get_usable_folder() is None


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="a system without users")
@pytest.mark.parametrize("mode", [0o770, 0o702])
def test_what_others_can_write_to_is_not_used(mode, tmp_path, monkeypatch):
    monkeypatch.setenv("SWITCHFIT_CACHE", str(tmp_path))
    tmp_path.chmod(mode)
    message = rf"The cache folder {tmp_path} is not used, .*: others may write to it \(drwx"
    with pytest.warns(UserWarning, match=message):
        assert get_usable_folder() is None
    assert get_usable_folder() is None  # without another warning, which would be an error here
    tmp_path.chmod(0o755)
    assert get_usable_folder() == tmp_path
