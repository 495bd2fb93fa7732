"""Float64 throughout, and no traces in JAX's configuration, its flags and its cache."""

import json
import os
import subprocess
import sys
from collections import OrderedDict

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from support.counted_traces import TRACES, oscillator
from support.models import one_run
from switchfit.problem import functions
from switchfit.runtime.xla_flags import SMALL_LOOPS, compile_small_loops_whole


@pytest.fixture(scope="module")
def compiled():
    """Evaluated and fitted once: everything below has to get by with the programs of this."""
    problem = oscillator()
    for method in ("auto", "adjoint"):
        sf.evaluate(problem, method=method)
    sf.simulate(problem)
    assert sf.estimate(problem).success
    assert TRACES["count"] > 0
    return problem


# float64 whatever the user has set


@pytest.fixture(params=[False, True], ids=["x64 off", "x64 on"])
def x64(request):
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", request.param)
    yield request.param
    assert jax.config.jax_enable_x64 is request.param
    assert jnp.zeros(1).dtype == (jnp.float64 if request.param else jnp.float32)
    jax.config.update("jax_enable_x64", before)


SEEN = []


def recorded(t, x, p):
    SEEN.extend([t.dtype, x.dtype, *(value.dtype for value in p.values())])
    return -p["k"] * x + p["offset"]


def decay(start=(1.0,)):
    """x' = -k x: x(1) = exp(-k)."""
    system = sf.HybridSystem({"decay": recorded}, start)
    run = sf.Experiment(sf.TerminalCost(lambda x, p: x[0]), ("decay",), (), 0.0, 1.0)
    offset = sf.Parameter(0.0, fixed=True)
    return sf.Problem(system, run, {"k": np.float32(1.5), "offset": offset}, rtol=1e-12, atol=1e-14)


def test_everything_is_float64_and_the_setting_as_before(x64, monkeypatch):
    """Arrays of single precision are accepted, as ``jnp.ones(1)`` is where the user has not enabled float64."""
    monkeypatch.setattr(functions, "_traces", OrderedDict())  # the functions are to be called again
    SEEN.clear()
    problem = decay(start=jnp.ones(1, jnp.float32))
    found, path = sf.evaluate(problem), sf.simulate(problem)
    assert found.cost == pytest.approx(np.exp(-1.5), rel=1e-13)
    np.testing.assert_allclose(found.gradient, [-np.exp(-1.5)], rtol=1e-12)
    np.testing.assert_allclose(found.hessian, [[np.exp(-1.5)]], rtol=1e-11)
    f32 = np.float32
    data = sf.Measurements(f32([0.0, 0.5]), f32([1.0, 0.5]), sigma=f32(0.25))
    run = sf.Experiment(data, ("decay",), (), f32(0.0), f32(1.0), initial_state=jnp.ones(1, jnp.float32))
    arrays = (found.gradient, found.hessian, path.states, path.times, data.values, data.weights, run.initial_state)
    assert {*SEEN, *(array.dtype for array in arrays)} == {np.dtype("float64")}


def test_the_setting_is_as_before_after_exceptions(compiled, x64):
    """Raised while a problem is built, while its mesh is refined, and by a callback."""

    for mode, message in (
        (lambda t, x, p: x.astype(jnp.float32), "must return float64; got float32"),
        (lambda t, x, p: 9.0 * x**2, "mode 'decay' cannot be integrated"),
    ):
        with pytest.raises(ValueError, match=message):
            sf.evaluate(sf.Problem(sf.HybridSystem({"decay": mode}, [1.0]), decay().experiments[0], {"k": 1.0}))
        assert jax.config.jax_enable_x64 is x64
    with pytest.raises(ZeroDivisionError):
        sf.estimate(compiled, callback=lambda record: 1 / 0)


# JAX's configuration

CACHE_SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_enable_compilation_cache",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@pytest.mark.parametrize(("place", "factor"), [("programs", 1.1), ("off", 1.2)])
def test_the_compilation_cache_is_used_or_off_and_its_configuration_as_before(place, factor, tmp_path, monkeypatch):
    """A factor not yet used makes a fit of one parameter compile."""
    before = [getattr(jax.config, name) for name in CACHE_SETTINGS]
    monkeypatch.setenv("SWITCHFIT_CACHE", place if place == "off" else str(tmp_path / place))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    system = sf.HybridSystem({"m": lambda t, x, p: -p["k"] * x * factor}, [1.0])
    fit = sf.estimate(one_run(system, sf.Measurements([0.5, 1.0], [0.6, 0.4]), ("m",), (), 1.0, {"k": 1.0}))
    assert sf.simulate(fit.problem).times[-1] == 1.0
    assert [getattr(jax.config, name) for name in CACHE_SETTINGS] == before
    assert [path.name for path in tmp_path.iterdir()] == ([] if place == "off" else [place])


HEAVY = (
    *("bokeh", "jinja2", "switchfit.report.html.page", "matplotlib", "pydantic", "typer", "rich"),
    *("scipy.optimize", "scipy.integrate", "scipy.sparse", "scipy.interpolate", "scipy.stats"),
)


IMPORT = """
import json, os, sys, jax
before = dict(jax.config.values)
from switchfit import *
import switchfit.report
changed = [k for k, v in jax.config.values.items() if before.get(k, v) != v]
missing = set(switchfit.__all__) - set(globals())
print(json.dumps([changed, list(missing), list(sys.modules), os.environ.get("XLA_FLAGS")]))
"""


def test_import_has_no_side_effects():
    """Neither on JAX's configuration, nor by loading what only some calls need; XLA's flags alone are set."""
    env = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run([sys.executable, "-c", IMPORT], capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr
    changed, missing, modules, flags = json.loads(done.stdout)
    assert (changed, missing, set(HEAVY) & set(modules), flags) == ([], [], set(), SMALL_LOOPS)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("", SMALL_LOOPS),
        ("--xla_cpu_enable_fast_math=false", f"--xla_cpu_enable_fast_math=false {SMALL_LOOPS}"),
        ("--xla_backend_extra_options=mine=1", "--xla_backend_extra_options=mine=1"),
    ],
)
def test_the_flags_for_xla_are_added_to_those_of_the_user(given, expected, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", given)
    compile_small_loops_whole()
    assert os.environ["XLA_FLAGS"] == expected
