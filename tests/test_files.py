"""Files that survive what happens to files: kills, full disks, damage, other processes, other users."""

from __future__ import annotations

import errno
import os
import random
import stat
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import numpy as np
import pytest

from switchfit.batch.chunks import run_chunks
from switchfit.runtime.cache import get_usable_folder, read_code, write_code
from switchfit.runtime.files import write_atomically

SOURCE = Path(__file__).parent.parent / "src"


def start(program: str, *arguments: object, **environment: str) -> subprocess.Popen[str]:
    """A Python process of its own."""
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": str(SOURCE)} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


# --- one writer -------------------------------------------------------------------------------------------------------

SLOW_WRITER = """
import os, sys, time
from pathlib import Path
from switchfit.runtime import files
def sync(handle):
    print("writing", flush=True)
    time.sleep(float(sys.argv[2]))
os.fsync = sync
files.write_atomically(b"new" * 1000, Path(sys.argv[1]))
"""


def test_a_killed_process_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("old")
    process = start(SLOW_WRITER, path, 60)
    assert process.stdout.readline() == "writing\n"
    process.kill()
    process.communicate()
    assert len(list(tmp_path.iterdir())) == 2
    assert path.read_text() == "old"
    write_atomically("new", path)
    assert path.read_text() == "new"


def test_a_file_that_another_process_is_writing_is_left_alone(tmp_path):
    process = start(SLOW_WRITER, tmp_path / "a.json", 1.0)
    assert process.stdout.readline() == "writing\n"
    write_atomically("other", tmp_path / "b.json")
    assert len(list(tmp_path.iterdir())) == 2
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert (tmp_path / "a.json").read_bytes() == b"new" * 1000
    assert len(list(tmp_path.iterdir())) == 2


def test_many_writers_of_one_file(tmp_path):
    """At every moment the file is one that somebody wrote."""
    path = tmp_path / "a.json"
    path.write_text("0" * 10_000)
    stop, wrong = threading.Event(), []

    def write(digit):
        for _ in range(40):
            write_atomically(str(digit) * 10_000, path)

    def read():
        while not stop.is_set():
            text = path.read_text()
            if len(text) != 10_000 or len(set(text)) != 1:
                wrong.append(text)

    reader = threading.Thread(target=read)
    writers = [threading.Thread(target=write, args=(digit,)) for digit in range(1, 7)]
    for thread in (reader, *writers):
        thread.start()
    for thread in writers:
        thread.join()
    stop.set()
    reader.join()
    assert not wrong
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.json"]


def test_a_disk_that_is_full_half_way(tmp_path):
    """By the limit on the size of files: the first half is written, then writing fails."""
    (tmp_path / "a.json").write_text("old")
    program = (
        "import resource, signal, sys\nfrom pathlib import Path\n"
        "from switchfit.runtime.files import write_atomically\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))\n"
        "write_atomically(b'x' * 100_000, Path(sys.argv[1]))\n"
    )
    process = start(program, tmp_path / "a.json")
    _, errors = process.communicate()
    assert process.returncode == 1
    assert errors.splitlines()[-1] == f"OSError: [Errno 27] File too large: '{tmp_path / 'a.json'}'"
    assert (tmp_path / "a.json").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 64 kB; skips where none can be mounted."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(disk)]
    try:
        mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("no file system can be mounted here")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_study_on_a_full_disk_goes_on_when_there_is_room(small_disk):
    filler = small_disk / "filler"
    filler.write_bytes(bytes(40_000))
    folder = small_disk / "study"
    with pytest.raises(OSError, match=r"No space left on device: .*chunk-0000\d+\.npz"):
        run_chunks(Heavy(), 12, folder=folder)
    assert all(entry.suffix == ".npz" for entry in folder.iterdir())
    filler.unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        runs, arrays = run_chunks(Heavy(), 12, folder=folder)
    np.testing.assert_array_equal(runs, np.arange(12))
    np.testing.assert_array_equal(arrays["value"], np.repeat(np.arange(12.0)[:, None], 300, axis=1))


def test_a_device_is_written_to_and_not_replaced():
    write_atomically("gone", Path(os.devnull))
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)


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


class Heavy:
    """Chunks of 5 kB."""

    size = 2

    def __call__(self, runs):
        return {"value": np.repeat(np.asarray(runs, dtype=float)[:, None], 300, axis=1)}

    def fingerprint(self):
        return "heavy"


@pytest.fixture
def study(tmp_path):
    """A folder with the chunks of 10 runs, and what they hold."""
    _, arrays = run_chunks(Squares(), 10, folder=tmp_path / "study")
    return tmp_path / "study", arrays


def again(folder, arrays, computed):
    """Run once more: the same arrays, with just these chunks computed; and once more without anything to do."""
    for expected in (computed, []):
        work = Squares()
        runs, found = run_chunks(work, 10, folder=folder)
        assert sorted(work.computed) == expected
        np.testing.assert_array_equal(runs, np.arange(10))
        assert found.keys() == arrays.keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array)


def rewritten(change):
    """A chunk with other arrays in a valid file."""

    def damage(path):
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        change(arrays)
        np.savez(path, **arrays)

    return damage


def put(name, value):
    return lambda arrays: arrays.__setitem__(name, value(arrays[name]))


DAMAGES = {
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:-200]),
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("not mine"),
    "objects": rewritten(put("text", lambda text: text.astype(object))),
    "a field missing": rewritten(lambda arrays: arrays.pop("row")),
    "a field more": rewritten(lambda arrays: arrays.update(more=np.zeros(3))),
    "no seal": rewritten(lambda arrays: arrays.pop("seal")),
    "other dtype": rewritten(put("square", lambda square: square.astype(np.float32))),
    "other shape": rewritten(put("row", lambda row: row[:, :1])),
    "other numbers": rewritten(put("square", lambda square: square + 1e-9)),
    "scalar": rewritten(put("row", lambda row: np.array(1.0))),
    "of another run": rewritten(put("fingerprint", lambda name: np.array("cubes"))),
    "another chunk": lambda path: path.write_bytes((path.parent / "chunk-00000006.npz").read_bytes()),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_chunk_is_named_set_aside_and_computed_again(damage, study):
    folder, arrays = study
    path = folder / "chunk-00000003.npz"
    DAMAGES[damage](path)
    content = path.read_bytes()
    with pytest.warns(UserWarning, match=r"chunk-00000003\.npz is damaged: .*Runs 3 to 5 are computed") as said:
        again(folder, arrays, [3])
    assert len(said) == 1
    assert str(path) in str(said[0].message)
    assert (folder / "chunk-00000003.npz.damaged").read_bytes() == content
    # And if it happens a second time, what was set aside first stays.
    path.write_bytes(b"")
    with pytest.warns(UserWarning, match="No data left in file"):
        again(folder, arrays, [3])
    assert (folder / "chunk-00000003.npz.damaged").read_bytes() == content
    assert (folder / "chunk-00000003.npz.damaged-2").read_bytes() == b""


@pytest.mark.parametrize("seed", range(40))
def test_a_chunk_with_damaged_bytes(seed, study):
    """Whatever happens to a file, the numbers are those of the first time."""
    folder, arrays = study
    rng = random.Random(seed)
    path = folder / "chunk-00000000.npz"
    data = bytearray(path.read_bytes())
    for _ in range(rng.choice([1, 2, 20])):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    if rng.random() < 0.3:
        del data[rng.randrange(len(data)) :]
    path.write_bytes(data)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        # A bit that nothing reads may flip: then the chunk is as good as it was.
        work = Squares()
        _, found = run_chunks(work, 10, folder=folder)
    assert [str(path) in str(warning.message) for warning in said] == [True] * len(work.computed)
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
    again(folder, arrays, [])


def test_chunks_of_a_study_that_goes_on_further(study):
    folder, arrays = study
    work = Squares()
    _, found = run_chunks(work, 12, folder=folder)
    assert work.computed == [9]  # the last one, which was shorter
    np.testing.assert_array_equal(found["square"][:10], arrays["square"])


def test_chunks_of_another_run_are_neither_used_nor_touched(study):
    folder, _ = study
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(ValueError, match="holds the results of another run"):
        run_chunks(Squares("cubes"), 10, folder=folder)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_folder_with_other_files_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="holds other files: give an empty or a new folder"):
        run_chunks(Squares(), 10, folder=tmp_path)


# --- the cache --------------------------------------------------------------------------------------------------------

ONLY_WHERE_THERE_ARE_USERS = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="a system without users")


@ONLY_WHERE_THERE_ARE_USERS
def test_the_cache_folder_is_made_for_the_user_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("SWITCHFIT_CACHE", str(tmp_path / "a" / "cache"))
    before = os.umask(0)
    try:
        assert get_usable_folder() == tmp_path / "a" / "cache"
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a" / "cache").stat().st_mode) == 0o700


@ONLY_WHERE_THERE_ARE_USERS
@pytest.mark.parametrize("mode", [0o770, 0o702, 0o777])
def test_a_cache_folder_that_others_can_write_to_is_not_used(mode, tmp_path, monkeypatch):
    monkeypatch.setenv("SWITCHFIT_CACHE", str(tmp_path))
    tmp_path.chmod(mode)
    message = rf"The cache folder {tmp_path} is not used, .*: others may write to it \(drwx"
    with pytest.warns(UserWarning, match=message):
        assert get_usable_folder() is None
    assert get_usable_folder() is None  # without another warning, which would be an error here
    tmp_path.chmod(0o755)
    assert get_usable_folder() == tmp_path


@ONLY_WHERE_THERE_ARE_USERS
def test_a_cache_folder_of_another_user_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv("SWITCHFIT_CACHE", str(tmp_path))
    owner = tmp_path.stat().st_uid
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    with pytest.warns(UserWarning, match=f"it belongs to the user with the number {owner}, not to you"):
        assert get_usable_folder() is None


@ONLY_WHERE_THERE_ARE_USERS
def test_a_file_that_others_can_write_to_is_not_run(tmp_path):
    path = tmp_path / "native-1"
    write_code(path, b"code")
    assert read_code(path) == b"code"
    path.chmod(0o666)
    assert read_code(path) is None


def test_a_failed_write_into_the_cache_leaves_nothing(tmp_path, monkeypatch):
    def full(self, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "replace", full)
    write_code(tmp_path / "native-1", b"code")
    assert not list(tmp_path.iterdir())


FIT = """
import sys, warnings
warnings.simplefilter("error")
import numpy as np, switchfit as sf
rate = float(sys.argv[1])
system = sf.HybridSystem({"up": lambda t, x, p: rate * p["v"] + 0 * x, "rest": lambda t, x, p: 0 * x}, [0.0])
times = np.linspace(0.05, 1.95, 20)
data = sf.Measurements(times, 3.0 * np.minimum(times, 1.23), sigma=0.1)
run = sf.Experiment(data, ("up", "rest"), (1.0,), 0.0, 2.0)
problem = sf.Problem(system, run, {"v": sf.Parameter(2.0, lower=0.5, upper=5.0)})
fit = sf.estimate(problem)
print(fit.theta.tobytes().hex(), sf.simulate(problem).states.tobytes().hex())
if sys.argv[2:]:
    print(sf.monte_carlo(problem, 4, theta=fit.theta).theta.tobytes().hex())
"""


def numbers_of(*processes: subprocess.Popen[str]) -> list[str]:
    """What processes print; none of them may fail or warn."""
    found = []
    for process in processes:
        output, errors = process.communicate(timeout=600)
        assert process.returncode == 0, errors
        assert errors == ""
        found.append(output)
    return found


@pytest.mark.parametrize(
    "models",
    [
        pytest.param([("1",), ("1",)], id="same", marks=pytest.mark.slow),
        pytest.param([("1", "batch"), ("1", "batch")], id="same in a batch", marks=pytest.mark.slow),
        pytest.param([("1", "batch"), ("2", "batch")], id="different in a batch", marks=pytest.mark.slow),
        pytest.param([("1",), ("2",)] * 4, id="eight processes", marks=pytest.mark.slow),
    ],
)
def test_processes_on_one_cache(models, tmp_path):
    """From an empty cache at once, from the filled one, and from a damaged one: the same numbers as without a cache."""
    cache = tmp_path / "cache"
    alone = {model: numbers_of(start(FIT, *model, SWITCHFIT_CACHE="off"))[0] for model in dict.fromkeys(models)}
    for damage in (False, False, True):
        if damage:
            for path in cache.iterdir():
                path.write_bytes(path.read_bytes()[:-30])
        found = numbers_of(*(start(FIT, *model, SWITCHFIT_CACHE=str(cache)) for model in models))
        assert found == [alone[model] for model in models]
        kinds = {path.name.partition("-")[0] for path in cache.iterdir()}
        assert kinds == ({"native", "jax"} if "batch" in models[0] else {"native"})
        assert all(read_code(path) for path in cache.iterdir())
