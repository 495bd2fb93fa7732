"""The line of progress: on a terminal alone, from a second on, taken away at the end."""

import io
import sys
import threading
import time
import types

import numpy as np
import pytest

import switchfit as sf
from support.thermostats import FAR, thermostat
from switchfit.batch.chunks import run_chunks
from switchfit.runtime import progress
from switchfit.runtime.progress import show_detail, show_line, show_progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def open_terminal(monkeypatch):
    """Return a terminal in the place of stderr, where lines are shown at once; not in a fixture, since pytest's capture
    takes stderr back after it."""
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(progress, "DELAY", 0.001)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    return stream


def wait_for(text, read, seconds=5.0):
    end = time.monotonic() + seconds
    while text not in read() and time.monotonic() < end:
        time.sleep(0.01)
    return text in read()


def test_the_line_says_what_is_done_and_how_far_it_is(monkeypatch):
    terminal = open_terminal(monkeypatch)
    before = set(threading.enumerate())
    with show_line("begins") as line:
        assert wait_for("begins   ", terminal.getvalue)
        line.write("many starts", 3.0)
        show_detail("start 3 of at most 127", 2.0)
        assert wait_for("many starts, lowest J = 2, start 3 of at most 127   ", terminal.getvalue)
        line.write("other")
        assert wait_for("other   ", terminal.getvalue)
    assert terminal.getvalue().endswith("\x1b[2K")  # the line is erased
    with show_progress(lambda done, total: done, "runs") as report:
        assert report(3, 4) == 3
        assert wait_for("runs, 3/4, 0 s left", terminal.getvalue)
    for thread in set(threading.enumerate()) - before:
        thread.join(5.0)
        assert not thread.is_alive()
    found = sf.estimate(thermostat(FAR))
    shown = f"beam along the log, lowest J = {found.steps[0].cost:.6g}, run 1 of 1   "
    assert shown in terminal.getvalue()


def test_calls_inside_another_one_and_other_threads_show_nothing(monkeypatch):
    terminal = open_terminal(monkeypatch)

    def elsewhere():
        with show_line("thread"):
            time.sleep(0.1)

    with show_line("outer"):
        assert wait_for("outer", terminal.getvalue)
        with show_line("inner"):
            show_detail("deeper")
            time.sleep(0.3)
    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert not any(text in terminal.getvalue() for text in ("inner", "deeper", "thread"))


@pytest.mark.parametrize("where", ["no terminal", "closed", "no stderr", "ends at once"])
def test_nothing_is_shown(monkeypatch, where):
    """Programs without a console have None in the place of stderr; a daemon may have closed it."""
    stream = Terminal() if where == "ends at once" else io.StringIO()
    monkeypatch.setattr(sys, "stderr", None if where == "no stderr" else stream)
    if where == "closed":
        stream.close()
    if where != "ends at once":
        monkeypatch.setattr(progress, "DELAY", 0.001)
    with show_line("begins"):
        show_detail("more")
        time.sleep(0.1)
    with show_progress(None, "runs") as report:
        assert not report(1, 2)
    time.sleep(progress.DELAY + 0.3)
    assert where == "closed" or stream.getvalue() == ""
    show_detail("nowhere")


def test_a_notebook_shows_what_a_long_call_is_doing(monkeypatch, capfd):
    """A line that says what is done, and a bar; erased at the end."""
    ipython, module, shown = types.ModuleType("IPython"), types.ModuleType("IPython.display"), []
    ipython.get_ipython = lambda: types.SimpleNamespace(kernel=1)
    module.HTML = str
    module.display = lambda html, display_id: (shown.append(html), types.SimpleNamespace(update=shown.append))[1]
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    monkeypatch.setattr(progress, "DELAY", 0.0)
    monkeypatch.setattr(progress, "REDRAW", 0.001)

    def read():
        return "\n".join(shown)

    with progress.show_line("looks for <modes>") as line:
        assert wait_for("<progress></progress> looks for &lt;modes&gt;   0 s", read)
        line.write("many starts", 3.0)
        assert wait_for("many starts, lowest J = 3", read)
    assert shown[-1] == ""
    count = len(shown)
    time.sleep(0.1)
    assert len(shown) == count, "drawn after its end"
    with progress.show_progress(lambda done, total: done, "Profile of <k>") as report:
        assert report(1, 4) == 1
        assert wait_for('<progress value="1" max="4"></progress> Profile of &lt;k&gt;, 1/4, 0 s left', read)
    assert capfd.readouterr() == ("", "")


# A batch that is stopped


def test_a_batch_that_is_stopped_does_not_wait_for_the_chunk_under_way():
    released = threading.Event()

    def work(runs):
        if runs.start:
            released.wait(60.0)
        return {"run": np.array(runs)}

    work.size, work.fingerprint = 1, lambda: "endless"
    began = time.monotonic()
    runs, _ = run_chunks(work, 2, progress=lambda done, total: True)
    waited = time.monotonic() - began
    released.set()
    assert runs.tolist() == [0]
    assert waited < 30.0, "as long as the chunk"
