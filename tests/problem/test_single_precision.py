"""Numbers that lost digits in single precision are refused with the line that uses them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from switchfit.io.user_files import call, load_object

pytestmark = pytest.mark.promotes

K = jnp.array(0.1)  # JAX is in 32-bit mode here, as it is in a user's module
EXACT = jnp.array([0.5, 2.0])
TIMES = np.linspace(0.0, 1.0, 9)


def problem_of(mode=None, initial_state=(1.0,), data=None):
    modes = {"on": mode or (lambda t, x, p: -p["a"] * x), "off": lambda t, x, p: -0.5 * x}
    system = sf.HybridSystem(modes, initial_state)
    data = data or sf.Measurements(TIMES, np.exp(-TIMES), sigma=0.1)
    return sf.Problem(system, sf.Experiment(data, ("on", "off"), (0.4,), 0.0, 1.0), {"a": 0.8})


DRAG, HALF = jnp.array([0.5, 0.3]), jnp.array([0.3], jnp.bfloat16)
SIGNAL = sf.ReferenceSignal.from_samples(TIMES, TIMES, observe=lambda t, x, p: K * x)
ENDING = [sf.RunningCost(lambda t, x, p: x[0]), sf.TerminalConstraint(lambda x, p: x[0] - K)]
WITH_LINE = r"a constant of mode 'on' \(test_single_precision.py:\d+\) must be in double precision: "


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"mode": lambda t, x, p: -K * p["a"] * x}, WITH_LINE + "0.1 became 0.1000000014"),
        ({"mode": lambda t, x, p: -HALF * x}, WITH_LINE + r".*\(bfloat16\)"),
        ({"mode": lambda t, x, p: jax.lax.fori_loop(0, 2, lambda k, y: y - DRAG[1] * x, x)}, "a constant of mode 'on'"),
        ({"initial_state": lambda p: jnp.ones(1) * K}, "a constant of initial_state"),
        ({"data": ENDING}, "a constant of TerminalConstraint"),
        ({"data": SIGNAL}, "a constant of observe"),
    ],
)
def test_a_constant_in_single_precision_is_refused_with_its_line(given, said):
    with pytest.raises(ValueError, match=said) as caught:
        problem_of(**given)
    assert "write" in str(caught.value), "what to write instead"


@pytest.mark.parametrize(
    "mode",
    [
        lambda t, x, p: x.astype(jnp.float32).astype(jnp.float64),
        lambda t, x, p: jnp.float32(0.5) * x.astype(jnp.float32) + 0.0 * x,
        lambda t, x, p: -(EXACT[0] * EXACT[1]) * x,
        lambda t, x, p: jax.lax.fori_loop(0, 2, lambda k, y: y.astype(jnp.float16).astype(jnp.float64), x),
    ],
)
def test_a_function_that_casts_is_refused(mode):
    with pytest.raises(ValueError, match=r"mode 'on' computes in float(32|16) \(test_single_precision.py:\d+\)"):
        problem_of(mode)


@pytest.mark.parametrize(
    ("mode", "rate"),
    [
        (lambda t, x, p: -EXACT[0] * p["a"] * x, lambda a: -0.5 * a),
        (lambda t, x, p: -jnp.array([0.1]) * p["a"] * x, lambda a: -0.1 * a),
        (lambda t, x, p: x[jnp.array([0])] * p["a"], lambda a: a),
        (lambda t, x, p: jnp.where(EXACT[:1] > 0.25, x, -x), lambda a: 1.0),
    ],
)
def test_constants_that_lost_nothing_are_taken(mode, rate):
    found, meant = (sf.evaluate(problem_of(f)) for f in (mode, lambda t, x, p: rate(p["a"]) * x))
    assert found.cost == pytest.approx(meant.cost, rel=1e-14)
    np.testing.assert_allclose(found.gradient, meant.gradient, rtol=1e-12)


def test_a_model_file_is_run_in_double_precision(tmp_path):
    (tmp_path / "model.py").write_text(
        "import jax.numpy as jnp\nimport switchfit as sf\nK = jnp.array(0.1)\n"
        "def model(gain=0.3):\n    gain = jnp.array(gain)\n"
        "    return sf.HybridSystem({'on': lambda t, x, p: -K * gain * p['a'] * x}, jnp.array([0.1]))\n"
    )
    built = call(load_object("model.py:model", tmp_path, "system"), "system")
    assert built.initial_state.tolist() == [0.1]
    log = sf.Measurements(TIMES, np.exp(-TIMES), sigma=0.1)
    sf.Problem(built, sf.Experiment(log, ("on",), (), 0.0, 1.0), {"a": 0.8})
    assert jnp.array(0.1).dtype == jnp.float32
