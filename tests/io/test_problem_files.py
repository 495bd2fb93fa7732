"""Tables, Python files and problem files: what they give, and what they say when something is wrong."""

import re
from pathlib import Path

import numpy as np
import pytest

import switchfit as sf
from support.commands import run
from support.places import EXAMPLES
from support.problem_folder import (
    PROBLEM,
    ROOM,
    fill_folder,
)
from switchfit.io.problem_file.loading import load_problem
from switchfit.io.user_files import load_object
from switchfit.report.problem import write_problem
from switchfit.runtime.errors import InputError


@pytest.fixture
def folder(tmp_path):
    return fill_folder(tmp_path)


def changed(folder, *changes):
    """The problem file with (old, new) replaced, loaded."""
    text = PROBLEM
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "problem.toml").write_text(text)
    return load_problem(folder / "problem.toml")


def refused(folder, message, *changes):
    with pytest.raises(InputError, match=message) as caught:
        changed(folder, *changes)
    return str(caught.value)


# --- a problem file that is right -------------------------------------------------------------------------------------


def test_everything_in_the_file_arrives(folder):
    loaded = changed(folder)
    problem = loaded.problem
    experiment = problem.experiments[0]
    assert loaded.options == {"max_iterations": 50}
    assert problem.theta_names == ("tau_1", "heating", "cooling")
    np.testing.assert_array_equal(problem.initial_theta, [3.0, 0.3, 0.05])
    bounds = [problem.unknowns.lower, problem.unknowns.upper]
    np.testing.assert_array_equal(bounds, [[1.0, 0.0, -np.inf], [5.0, 2.0, np.inf]])
    assert problem.unknowns.units == ("s", "K/min", "")
    assert (problem.rtol, problem.atol, problem.min_duration) == (1e-7, sf.Problem.atol, 0.5)
    assert (experiment.name, experiment.t0, experiment.tf) == ("monday", 0.0, 6.0)
    (data,) = experiment.data
    np.testing.assert_array_equal(data.times, np.arange(7.0))
    np.testing.assert_array_equal(data.values[:, 0], [15.0, 15.4, np.nan, 16.3, 16.2, 16.1, 16.0])
    assert (data.names, data.sigma) == (("T",), 0.1)
    np.testing.assert_array_equal(data.observe(0.0, np.array([21.0]), {}), [21.0])
    text = write_problem(problem)
    assert "on -> off on [0, 6] s, at 3 s" in text
    assert "7 samples of T, 0 to 6 s, typically 1 s apart, 1 values missing" in text
    assert re.search(r"heating\s+0\.3 K/min\s+in \[0, 2\]", text)


def test_short_forms_and_defaults(folder):
    loaded = changed(
        folder,
        ("transition_times = [{ value = 3.0, lower = 1.0, upper = 5.0 }]", "transition_times = [3]"),
        ("t0 = 0.0\ntf = 6.0\n", ""),
        ('observe = ["T"]\nsigma = 0.1\n', ""),
        ("[options]\nmin_duration = 0.5\nrtol = 1e-7\nmax_iterations = 50\n", ""),
    )
    assert "on -> off on [0, 6] s (t0 and tf from the data), at 3 s" in write_problem(loaded.problem)
    data = loaded.problem.experiments[0].data[0]
    assert (data.sigma, data.observe, loaded.options, loaded.problem.rtol) == (None, None, {}, sf.Problem.rtol)
    problem = changed(folder, ("t0 = 0.0\ntf = 6.0\n", "tf = 7.5\n"), ("sigma = 0.1\n", "delay = 0.25\n")).problem
    assert "on [-0.25, 7.5] s (t0 from the data)" in write_problem(problem)


def data_of(folder, *changes):
    return changed(folder, *changes).problem.experiments[0].data[0]


@pytest.mark.parametrize(("offset", "first"), [("2000", 1), ('"first"', 0)])
def test_window_offset_and_scale(folder, offset, first):
    (folder / "log.csv").write_text("t,T\n" + "".join(f"{k},{k}.5\n" for k in range(1000, 9001, 1000)))
    more = f'time = "t"\nwindow = [3000, 8000]\ntime_offset = {offset}\ntime_scale = 1e-3'
    data = data_of(folder, ('time = "t"', more))
    np.testing.assert_array_equal(data.times, first + np.arange(6))
    np.testing.assert_array_equal(data.values[:, 0], 3000.5 + 1000 * np.arange(6))


def test_units_of_a_log(folder):
    """Those of its times must be the experiment's; those of its values are not those of sigma."""
    (folder / "log.csv").write_text("t;T;sd\nms;K;mK\n" + "".join(f"{k}000;1{k},5;2\n" for k in range(7)))
    refused(folder, r"are in ms, but time_unit of the experiment is 's'\. Set time_scale = 0\.001")
    data = data_of(folder, ("sigma = 0.1", 'sigma = ["sd"]\ntime_scale = 1e-3'))
    np.testing.assert_array_equal([data.times, data.values[:, 0] - 10.5], [np.arange(7)] * 2)
    assert (data.units, data.sigma[0, 0]) == (("K",), 2.0)
    assert data_of(folder, ("t0 = 0.0\ntf = 6.0\n", 'time_unit = "ms"\n')).times[-1] == 6000
    assert data_of(folder, ("t0 = 0.0\ntf = 6.0\n", ""), ("sigma = 0.1", "time_scale = 1")).times[-1] == 6000


@pytest.mark.parametrize(
    ("times", "said", "repair"),
    [("01132", "line 4, 1.0 follows 1.0.", "drop-dupl"), ("01324", "line 5, 2.0 foll", "sort")],
)
def test_times_out_of_order_are_said_with_their_line(folder, times, said, repair):
    (folder / "log.csv").write_text("t,T\n" + "".join(f"{t},{k}\n" for k, t in enumerate(times)))
    refused(folder, rf"data\[1\]: .* must increase strictly; in .*{said}.* repair = \['{repair}")
    data = data_of(folder, ("sigma = 0.1", 'repair = ["sort", "drop-duplicates"]'))
    np.testing.assert_array_equal(data.times, sorted(map(float, set(times))))


@pytest.mark.parametrize("options", [[], ["--no-run"]])
def test_check_says_what_is_odd(folder, options):
    (folder / "log.csv").write_text("t,T\n" + "".join(f"{t},{t}\n" for t in (0, 0.1, 0.2, 0.3, 0.4, 0.5, 5.5)))
    result = run("check", folder / "problem.toml", *options, code=0)
    assert "7 samples of T, 0 to 5.5 s" in result.stdout
    assert "log.csv, line 8: a gap of 5 after 0.5, where samples are" in result.stdout


def test_loss_delay_priors_and_scales(folder):
    problem = changed(
        folder,
        ("sigma = 0.1", 'sigma = "cooling"\nloss = "huber"\nloss_scale = 1.5\ndelay = "d"\nwindow = [1, 5]'),
        ("cooling = 0.05", 'd = { value = 0.1, lower = 0.0, upper = 0.5 }\ncooling = { value = 0.05, scale = "log" }'),
        ("value = 0.3, lower = 0.0", "value = 0.3, lower = 0.0, prior = { mean = 0.4, sd = 0.1 }"),
        ("value = 3.0, lower = 1.0", "value = 3.0, prior = { median = 3.0, log_sd = 0.2 }, lower = 1.0"),
    ).problem
    data = problem.experiments[0].data[0]
    assert (data.sigma, data.loss, data.loss_scale, data.delay) == (("cooling",), "huber", 1.5, "d")
    assert tuple(problem.unknowns.priors.texts()) == ("log-normal(3, 0.2)", "normal(0.4, 0.1)", "", "")
    assert problem.unknowns.log_names == ("cooling",)
    text = write_problem(problem)
    for part in ("late by d", "loss huber (1.5 sigma)", "prior: normal(0.4, 0.1)", "(log scale)"):
        assert part in text


def last_unknown(p, run):
    return p.theta_names[-1], p.unknowns.units[-1], p.initial_theta[-1], p.unknowns.lower[-1], p.unknowns.upper[-1]


NAMED = 't0 = 0.0\ninputs = { file = "log.csv", time = "t", columns = { left = "u", right = "sd" } }'
UNKNOWN_STATE = 't0 = 0.0\ninitial_state = [{ value = 17.0, lower = 0.0, upper = 20.0, unit = "°C" }]'
TF = sf.Parameter(7.0, 6.0, 9.0, prior=sf.Normal(7.5, 0.5))
FREE_END = "tf = { value = 7.0, lower = 6.0, upper = 9.0, prior = { mean = 7.5, sd = 0.5 } }"
MAPPED = 't0 = 0.0\nparameter_map = { heating = "cooling" }'
MAKE = '{ name = "room.py:make", arguments = { start = 18.0 } }'


@pytest.mark.parametrize(
    ("old", "new", "find", "expected"),
    [
        ("sigma = 0.1", 'sigma = ["sd"]', lambda p, run: run.data[0].sigma[:3, 0].tolist(), [0.1, 0.1, 0.2]),
        ('["T"]\nsigma', '"room.py:fahrenheit"\nsigma', lambda p, run: run.data[0].observe(0.0, 10.0, {}), 50.0),
        ("sigma = 0.1", 'kind = "reference"\nweights = [2.0]', lambda p, run: run.data[0].weights.tolist(), [[2.0]]),
        ("t0 = 0.0", "t0 = 0.0\ninitial_state = [17.0]", lambda p, run: run.initial_state, [17.0]),
        ("t0 = 0.0", UNKNOWN_STATE, last_unknown, ("T(t0)", "°C", 17.0, 0.0, 20.0)),
        ("tf = 6.0", FREE_END, lambda p, run: repr(run.tf), repr(TF)),
        ("t0 = 0.0", MAPPED, lambda p, run: run.parameter_map, {"heating": "cooling"}),
        ("t0 = 0.0", NAMED, lambda p, run: [run.inputs.values[name][2] for name in run.inputs.names], [1.0, 0.2]),
        ('"room.py:room"', MAKE, lambda p, run: p.system.initial_state, [18.0]),
        ("min_duration = 0.5", "atol = 1e-5", lambda p, run: (p.atol, p.min_duration), (1e-5, 0.0)),
    ],
)
def test_forms_of_keys(folder, old, new, find, expected):
    driven = ROOM.replace("(t, x, p)", "(t, x, p, u)")
    (folder / "room.py").write_text(driven if new == NAMED else ROOM)
    problem = changed(folder, (old, new)).problem
    assert find(problem, problem.experiments[0]) == expected


@pytest.mark.parametrize(
    ("name", "tau"), [('"built.py:problem"', 2.5), ('{ name = "built.py:make", arguments = { tau = 1.5 } }', 1.5)]
)
def test_problem_built_in_python(folder, name, tau):
    (folder / "built.py").write_text(
        "import switchfit as sf\nfrom room import room\n"  # a neighbour in the same folder
        "def make(tau=2.5):\n"
        "    run = sf.Experiment(sf.Measurements([1.0, 3.0], [15.0, 16.0]), ('on', 'off'), (tau,), 0.0, 4.0)\n"
        "    return sf.Problem(room, run, {'heating': 0.3, 'cooling': 0.05})\n"
        "problem = make()\n"
    )
    (folder / "p.toml").write_text(f'problem = {name}\n[options]\nhessian = "gauss-newton"\n')
    loaded = load_problem(folder / "p.toml")
    assert (loaded.problem.initial_theta[0], loaded.options) == (tau, {"hessian": "gauss-newton"})


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*/*.toml")), ids=lambda path: path.parent.name)
def test_examples_load(path):
    assert load_problem(path, searched="[library]" in path.read_text()).problem.theta_names


# --- a problem file that is wrong -------------------------------------------------------------------------------------


WRONG = [
    ("upper = 5.0 }", "uper = 5.0 }", r"'experiments\[1\]\.transition_times\[1\]\.uper'; did you mean 'upper'\?"),
    ('time = "t"', 'time = "t"\nwindow = [10, 20]', r"no time in column 't' lies in the window \[10\.0, 20\.0\]; "),
    ('observe = ["T"]', 'observe = ["x"]', r"data\[1\]: observe names the unknown state 'x'; the states are T"),
    ('["T"]\nobserve = ["T"]', '["T", "u"]', r"2 columns are not the whole state \(T\): add observe, a list of"),
    ("sigma = 0.1", 'sigma = 0.1\nkind = "reference"', r"sigma does not belong to kind = 'reference': meas"),
    ("sigma = 0.1", 'sigma = ["sd", 0.1]', r"sigma must name columns of the file alone, or parameters and numb"),
    ("value = 0.3,", "value = 0.3, prior = { mean = 1.0 },", r"prior needs mean and sd \(normal\), or median"),
    ('"log.csv"', r'"a\u0000b"', "is not a file name"),
    ("room.py:room", "room", r"model 'room' is not known; the built-in models are skid_steer, sliding"),
    ("rtol = 1e-7", 'hessian = "newton"', r"'options\.hessian' must be 'auto', 'exact', 'descent-first'"),
    ("[parameters]", "[parameters", r"is not valid TOML: .*line 3"),
    ('model = "room.py:room"', "", r"the key 'model' is missing; name one of skid_steer, sliding_block, magic"),
    ("room.py:room", "rom.py:room", r"model 'rom\.py:room': there is no file .*rom\.py"),
    ("room.py:room", "room.py", r"model must be given as 'file\.py:object'; got 'room\.py'"),
    ("room.py:room", "room.py:rom", r"room\.py defines no 'rom'; it has .*make, .*room"),
    ("room.py:room", "room.py:seven", r"model 'room\.py:seven' must be an sf\.HybridSystem or a .*got int"),
    ("room.py:room", "room.py:broken_factory", r"failed: .*room\.py, line 12, in broken_factory: RuntimeError: no"),
    ("room.py:room", "room.py:broken", r"room\.py, line 14, in broken_mode: mode 'on': .* NameError: name 'undef"),
    ("room.py:room", "room.py:nameless", r"observe names states, but the model has no state_names; add them"),
    ('"room.py:room"', '{ name = "room.py:room", arguments = { a = 1 } }', "is not a function; leave out its arg"),
    ('"room.py:room"', '{ name = "room.py:make", arguments = { a = 1 } }', "argument 'a'; it takes start"),
    ('model = "room.py:room"', 'problem = "room.py:seven"', r"leave out parameters and experiments"),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG)
def test_what_is_wrong_is_said(folder, old, new, message):
    said = refused(folder, message, (old, new))
    assert str(folder) in said  # the file is named
    assert "\n" not in said  # in one sentence


def test_several_mistakes_are_listed(folder):
    said = refused(folder, r"unknown key 'experiments", ("tf = 6.0", "t_f = 6.0"), ("sigma = 0.1", "sigma = true"))
    assert "Also wrong: 'experiments[1].data[1].sigma'" in said


BEGIN = r" is not valid TOML: .* begin with: switchfit init NAME --from .*"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("", None, " is a folder; name the problem file in it"),
        ("a.toml", b"\xff\xfe", r"a\.toml is not valid TOML: [^:]*: invalid start byte\.$"),
        ("a.toml", b"a = " + b"[" * 5000, r"a\.toml is not valid TOML: maximum recursion depth"),
        ("log.csv", b"t,x\n0,1\n", rf"log\.csv{BEGIN}log\.csv$"),
        ("a.toml", b'model = "skid_steer"\n', r"\[\[experiments\]\] is missing; give at least one"),
        ("a.toml", b'problem = "room.py:seven"\n[options]\nrtol = 1', r"with 'problem', rtol is set where the sf\.Pro"),
    ],
)
def test_files_that_hold_no_problem(folder, name, content, message):
    if content:
        (folder / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_problem(folder / name)


# --- Python files -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\ny = x +\n", r"Running .*m\.py failed: .*m\.py, line 2: SyntaxError: invalid syntax"),
        ("def f():\n    return 1 / 0\n\nx = f()\n", r"m\.py, line 2, in f: ZeroDivisionError: division by zero"),
        ("raise SystemExit('bye.')\n", r"^Running m\.py failed: m\.py, line 1: SystemExit: bye\.$"),
    ],
)
def test_python_file_that_fails(tmp_path, text, message, monkeypatch):
    """It is named as the user named it."""
    monkeypatch.chdir(tmp_path)
    Path("m.py").write_text(text)
    with pytest.raises(InputError, match=message):
        load_object("m.py:x", Path(), "model")


def test_python_file_is_read_again_when_it_changes(tmp_path):
    path = tmp_path / "m.py"
    path.write_text("x = object()\n")
    first = load_object("m.py:x", tmp_path, "model")
    assert load_object("m.py:x", tmp_path, "model") is first
    path.write_text("x = 5\n")
    assert load_object("m.py:x", tmp_path, "model") == 5


# --- what check says --------------------------------------------------------------------------------------------------
