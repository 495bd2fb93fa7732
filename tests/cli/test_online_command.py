"""`switchfit online`: samples from logs and from stdin, states and journals, Ctrl-C, kill, and the live page."""

import json
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import contextmanager

import numpy as np
import pytest

import switchfit as sf
from support.commands import catch_settings, run
from support.mode_search_folder import PROBLEM, TIMES, fill, simulate, write_log
from switchfit.cli.live_page import MOST_KEPT_LINES, LivePage
from switchfit.io.problem_file.loading import load_problem
from switchfit.runtime.errors import InputError

VALUES = simulate(TIMES, (2.5, 5.5))
LINES = [json.dumps({"t": t, "y": [value]}) for t, value in zip(TIMES.tolist(), VALUES.tolist(), strict=True)]
PROGRAM = "from switchfit.cli import main; main()"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log of rise -> fall -> rise."""
    return fill(tmp_path_factory.mktemp("online"))


def feed(folder, lines, *options, code=None):
    """The command, with lines on its stdin."""
    text = "".join(f"{line}\n" for line in lines)
    return run("online", folder / "problem.toml", "--stdin", *options, code=code, input=text)


def read(result):
    """What was printed, without what each update took."""
    found = [json.loads(line) for line in result.stdout.splitlines()]
    for line in found:
        assert line.pop("seconds") > 0
    return found


@pytest.fixture(scope="module")
def replayed(folder):
    return run("online", folder / "problem.toml", "--out", folder / "out" / "deep")


def test_a_line_of_json_for_each_sample(replayed, folder):
    """They say what the estimator says; the [library] of the file is read as `switchfit modes` does."""
    assert replayed.exit_code == 0, replayed.stderr
    lines = read(replayed)
    library = {"successions": {"rise": ["fall", "drift"], "fall": ["rise"]}, "min_duration": 0.2}
    log = sf.replay(load_problem(folder / "problem.toml", searched=True).problem, **library)
    assert [line["t"] for line in lines] == list(TIMES)
    assert [line["statistic"] for line in lines] == [v if np.isfinite(v) else None for v in log.statistic.tolist()]
    assert [line["status"] for line in lines] == [status.name for status in log.status]
    last = lines[-1]
    assert (last["mode"], last["mode_sequence"]) == ("rise", ["rise", "fall", "rise"])
    assert last["since"] == last["transition_times"][-1] == log.now.since
    assert last["parameters"] == {name: value.tolist() for name, value in log.now.parameters.items()}
    assert last["standard_errors"]["c"] is None, "of a mode that has not occurred"
    assert [line["alarm"]["mode"] for line in lines if line["alarm"]] == [alarm.mode for alarm in log.alarms]
    assert [line["retracted"] for line in lines if line["retracted"]] == [each._asdict() for each in log.retracted]
    out = folder / "out" / "deep"
    assert replayed.stderr == f"written to {out}\n"
    assert (out / "online.txt").read_text().startswith("rise since 5.48")
    assert (out / "online.png").read_bytes().startswith(b"\x89PNG")
    write_log(folder / "other.csv", VALUES[:30], times=TIMES[:30])
    another = run("online", folder / "problem.toml", "--replay", folder / "other.csv")
    assert read(another) == lines[:30]


def test_a_stream_needs_no_log(tmp_path):
    """Data and inputs of the problem file name no file, and it has no tf."""
    result = feed(fill(tmp_path, PROBLEM.replace('file = "log.csv"\n', "").replace("tf = 8.0\n", "")), LINES, code=0)
    lines = read(result)
    assert lines[-1]["mode_sequence"] == ["rise", "fall", "rise"]
    assert lines[-1]["since"] == pytest.approx(5.5, abs=0.1)
    assert "the key 'file' is missing" in run("online", tmp_path / "problem.toml", code=2).stderr


BAD = {
    "[" * 5000: "a sample is one line of JSON with the keys t, y and u",
    "\xff": "a sample is one line of JSON with the keys t, y and u",
    '{"y": [1.0]}': "a sample is one line of JSON with the keys t, y and u",
    '{"t": 1.0, "z": [1.0]}': "a sample is one line of JSON with the keys t, y and u",
    '{"t": null, "y": [1.0]}': "t must be",
    '{"t": 1.4, "y": {"Q": 1.0}}': "y has 'Q', which is no channel; there are: T",
    '{"t": 1.4, "y": "warm"}': "must be a number or an array of numbers",
    '{"t": 1.4, "y": [1.0], "u": 2.0}': "u was given, but the experiment has no inputs",
}


def test_lines_that_cannot_be_used_are_named_and_left_out(folder, replayed):
    """The others count as if they were not there, by the names of channels, too; an empty line is none."""
    named = [json.dumps({"t": t, "y": {"T": value}}) for t, value in zip(TIMES, VALUES, strict=True)]
    result = feed(folder, [*LINES[:10], *BAD, "", *named[10:]], code=2)
    assert read(result) == read(replayed)
    said = result.stderr.splitlines()
    for number, (line, message) in enumerate(BAD.items(), start=11):
        assert said[number - 11].startswith(f"switchfit: line {number}: "), line
        assert message in said[number - 11]
        assert len(said[number - 11]) < 500
    assert said[len(BAD) :] == [f"switchfit: {len(BAD)} lines of stdin could not be used."]


def test_missing_values_and_mere_time(folder):
    lines = [*LINES[:5], '{"t": 0.7, "y": [null]}', '{"t": 0.75, "y": {"T": null}}', '{"t": 0.8}']
    result = feed(folder, lines, code=0)
    assert [line["t"] for line in read(result)][5:] == [0.7, 0.75, 0.8]


def test_inputs_hold_from_their_sample_on(tmp_path):
    """As in the replay of the log, and without a log, where the first sample has the input alone."""
    text = PROBLEM.split("[library]")[0].replace("model.py:system", "model.py:driven").replace("c = 0.1\n", "")
    text = text.replace("tf = 8.0", 'mode_sequence = ["pushed"]')
    text += '[experiments.inputs]\nfile = "log.csv"\ntime = "t"\ncolumns = ["u"]\n'
    fill(tmp_path, text)
    times, values = np.r_[0.0, TIMES], np.r_[np.nan, VALUES]
    write_log(tmp_path / "log.csv", values, np.full(61, 3.0), times=times, names=("T", "u"))
    replayed = read(run("online", tmp_path / "problem.toml"))[20]
    (tmp_path / "problem.toml").write_text(text.replace('file = "log.csv"\n', ""))
    driven = [json.dumps(json.loads(line) | {"u": 3.0}) for line in LINES[:20]]
    result = feed(tmp_path, ['{"t": 0.0, "u": 3.0}', *driven], code=0)
    last = read(result)[-1]
    assert (last["t"], last["mode"]) == (replayed["t"], replayed["mode"])
    assert last["parameters"]["a"] == pytest.approx(replayed["parameters"]["a"], rel=1e-4)


def test_dates(tmp_path):
    fill(tmp_path, PROBLEM.replace("t0 = 0.0", "origin = 2024-05-01T12:00:00Z\nt0 = 0.0"))
    result = feed(tmp_path, ['{"t": "2024-05-01T12:00:00.5Z", "y": [0.9]}', '{"t": 0.6, "y": [1.0]}'], code=0)
    assert [(line["t"], line["date"][17:23]) for line in read(result)] == [(0.5, "00.500"), (0.6, "00.600")]
    assert "a number or a date" in feed(tmp_path, ['{"t": "tomorrow"}']).stderr


def test_options_are_those_of_the_estimator_and_come_before_the_file(tmp_path, monkeypatch):
    given = catch_settings(monkeypatch, "OnlineEstimator")
    fill(tmp_path, PROBLEM + '[online]\nwindow = 3.0\nrenews = { rise = "a" }\ndrift = { c = 0.1 }\n')
    run("online", tmp_path / "problem.toml")
    assert (given["window"], given["renews"], given["drift"]) == (3.0, {"rise": ["a"]}, {"c": 0.1})
    options = ("--window", 2, "--threshold", 9, "--max-switches", 3, "--budget", 0.1)
    assert run("online", tmp_path / "problem.toml", *options, code=2).stderr == "switchfit: enough\n"
    assert given.items() >= {"window": 2.0, "threshold": 9.0, "max_switches": 3, "budget": 0.1}.items()


def test_modes_that_the_library_leaves_out_never_follow(tmp_path):
    text = PROBLEM.split("[library]")[0].replace('file = "log.csv"\n', "")
    result = feed(fill(tmp_path, f'{text}[library]\nmodes = ["rise"]\n'), LINES[:45], code=1)
    assert {line["mode"] for line in read(result)} == {"rise"}
    assert result.stderr.startswith("switchfit: the samples are not what the model predicts")


def test_the_threshold_for_a_rate_of_false_alarms_is_named(folder, monkeypatch):
    from switchfit.online import estimator

    monkeypatch.setattr(estimator, "calibrate", lambda online, rate: type("Found", (), {"threshold": 100 * rate}))
    result = feed(folder, LINES[:3], "--false-alarms", 0.2)
    assert (result.exit_code, result.stderr) == (0, "threshold 20\n")
    assert {line["threshold"] for line in read(result)} == {20.0}
    quiet = feed(folder, LINES[:3], "--quiet")
    assert (quiet.exit_code, quiet.output) == (0, "")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--stdin", "--replay", "log.csv"), "--replay and --stdin contradict each other; give one of them."),
        (("--stdin",), "there were no samples."),
        (("--live", 99999), "the page cannot be served on port 99999: "),
        (("--replay", "missing.csv"), "missing.csv"),
    ],
)
def test_wrong_input(folder, options, message):
    result = run("online", folder / "problem.toml", *options, code=2)
    assert message in result.stderr
    assert result.stdout == ""


# --- states and journals ----------------------------------------------------------------------------------------------


def test_a_state_goes_on(folder, replayed, tmp_path):
    """Bit for bit, of stdin and of a log, whose samples up to then are not fed again; the threshold is the state's."""
    state = tmp_path / "deep" / "state"
    first = feed(folder, LINES[:25], "--state", state, "--threshold", 11.0, code=0)
    kept = state.read_bytes()
    second = feed(folder, LINES[25:], "--state", state)
    assert second.stderr == f"going on from t = {TIMES[24]:.6g}, with the threshold 11\n"
    whole = read(feed(folder, LINES, "--threshold", 11.0))
    assert read(first) + read(second) == whole
    state.write_bytes(kept)
    assert read(run("online", folder / "problem.toml", "--state", state)) == whole[25:]
    nothing_new = run("online", folder / "problem.toml", "--state", state)
    assert (nothing_new.exit_code, nothing_new.stdout) == (0, "")


def test_a_journal_is_emptied_by_a_state(folder, tmp_path):
    state, journal = tmp_path / "state", tmp_path / "journal"
    feed(folder, LINES[:10], "--journal", journal)
    assert len(journal.read_bytes().splitlines()) == 10
    feed(folder, LINES[10:20], "--journal", journal, "--state", state)
    assert journal.read_bytes() == b""
    assert "going on from t = " in feed(folder, LINES[20:], "--journal", journal, "--state", state).stderr


@contextmanager
def start(folder, *options):
    """The command as a process, whose stdin stays open, and which Ctrl-C reaches: in a job of the shell's background it
    would be ignored.
    """
    program = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {PROGRAM}"
    command = [sys.executable, "-c", program, "online", str(folder / "problem.toml"), "--stdin", *map(str, options)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **pipes) as process:
        try:
            yield process
        finally:
            process.kill()  # without effect if it has ended


def write_and_read(process, lines):
    """Write lines one by one, each after the answer to the one before."""
    found = []
    for line in lines:
        process.stdin.write(f"{line}\n")
        process.stdin.flush()
        found.append(json.loads(process.stdout.readline()))
    return found


def test_kill_9_loses_nothing_that_was_answered(folder, replayed, tmp_path, quick_processes):
    """A line of the journal that was cut off, as where the machine lost its power, is left out, and does no harm."""
    journal = tmp_path / "journal"
    with start(folder, "--journal", journal) as process:
        write_and_read(process, LINES[:30])
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    with journal.open("ab") as file:
        file.write(journal.read_bytes().splitlines()[-1][:7])
    result = feed(folder, LINES[30:40], "--journal", journal, code=0)
    assert read(result) == read(replayed)[30:40]
    assert read(feed(folder, LINES[40:], "--journal", journal)) == read(replayed)[40:]


def test_a_reader_that_is_gone_ends_nothing_and_the_page_stays(folder, tmp_path, quick_processes):
    with start(folder, "--out", tmp_path, "--live", 0) as process:
        address = process.stderr.readline().removeprefix("live at ").strip()
        write_and_read(process, LINES[:2])
        process.stdout.close()
        process.stdin.write("\n".join(LINES[2:20]))
        process.stdin.close()
        said = [process.stderr.readline() for _ in range(2)]
        assert said == [f"written to {tmp_path}\n", "the samples have ended; Ctrl-C ends the page\n"]
        with urllib.request.urlopen(address) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
        assert "Traceback" not in process.stderr.read()
    assert "20 updates" in (tmp_path / "online.txt").read_text()


def test_ctrl_c_while_it_waits_keeps_what_there_is(folder, tmp_path, quick_processes):
    """The live page is served until then."""
    out, state = tmp_path / "out", tmp_path / "state"
    with start(folder, "--out", out, "--state", state, "--live", 0) as process:
        address = process.stderr.readline().removeprefix("live at ").strip()
        said = write_and_read(process, LINES[:12])
        with urllib.request.urlopen(f"{address}/now.json") as answer:
            assert json.load(answer)["lines"] == said
        time.sleep(0.2)  # it waits for the next line
        process.send_signal(signal.SIGINT)
        assert "Traceback" not in process.stderr.read()
        assert process.wait(timeout=60) == 0
    assert (out / "online.txt").read_text().startswith("rise since 0 s")
    assert read(feed(folder, LINES[12:14], "--state", state))[0]["t"] == TIMES[12]


# --- the live page ----------------------------------------------------------------------------------------------------


@pytest.fixture
def page(folder):
    with LivePage("problem.toml", load_problem(folder / "problem.toml", searched=True).problem, 0) as page:
        yield page


def get(page, path, **headers):
    with urllib.request.urlopen(urllib.request.Request(page.address + path, headers=headers)) as answer:
        return answer.headers, answer.read().decode()


def test_the_page_is_one_file_that_asks_this_machine_only(page):
    headers, text = get(page, "/")
    assert "connect-src 'self'" in headers["Content-Security-Policy"]
    assert "https://" not in text
    assert page.address.startswith("http://127.0.0.1:")
    for path, host, code in (("/etc/passwd", "127.0.0.1", 404), ("/", "evil.example:80", 403)):
        with pytest.raises(urllib.error.HTTPError) as caught:
            get(page, path, Host=host)
        with caught.value as answer:
            assert answer.code == code


def test_readers_get_what_is_new(page):
    for k in range(5):
        page.show(json.dumps({"k": k}))
    for after, expected in {"3": [3, 4], "5": [], "99": [0, 1, 2, 3, 4], "9" * 5000: [0, 1, 2, 3, 4]}.items():
        lines = json.loads(get(page, f"/now.json?after={after}")[1])["lines"]
        assert [line["k"] for line in lines] == expected
    for k in range(5, MOST_KEPT_LINES + 100):
        page.show(json.dumps({"k": k}))
    found = json.loads(get(page, "/now.json?after=10")[1])
    assert list(found["head"]["colours"]) == ["rise", "fall", "drift"]
    assert (found["count"], found["lines"][0]["k"], len(found["lines"])) == (
        MOST_KEPT_LINES + 100,
        100,
        MOST_KEPT_LINES,
    )


def test_a_port_that_is_taken(page, folder):
    port = int(page.address.rpartition(":")[2])
    with pytest.raises(InputError, match=f"the page cannot be served on port {port}: .*; name another with --live"):
        LivePage("problem.toml", load_problem(folder / "problem.toml", searched=True).problem, port)
    with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.2", port), timeout=5):
        pass  # an address of this machine that is not that of the page


@pytest.mark.slow
def test_the_page_in_a_browser(browser, page, replayed):
    """It draws what has come, without an error, and asks nothing of any other machine."""
    browser.call("Page.navigate", url=page.address)
    for line in replayed.stdout.splitlines():
        page.show(line)
    browser.wait("document.getElementById('mode')?.textContent === 'rise'")
    assert browser.evaluate("document.querySelectorAll('.chart').length") == 6, "mode, statistic, a, b, c, time"
    assert browser.evaluate("document.querySelectorAll('.alarm').length") == 2
    assert browser.errors == []
    asked = {url.removeprefix(page.address)[:9] for url in browser.requests if url.startswith("http")}
    assert asked <= {"/", "/now.json"}
