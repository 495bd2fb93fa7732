"""The examples, run."""

import runpy
from pathlib import Path

import numpy as np

import switchfit as sf

EXAMPLES = Path(__file__).parent.parent / "examples"


def test_own_model_finds_what_made_its_log(capsys):
    problem = runpy.run_path(str(EXAMPLES / "own_model.py"))["problem"]
    estimate = sf.estimate(problem)
    assert estimate.success
    error = estimate.theta - [43.0, 0.5, 0.02]
    assert np.all(np.abs(error) < 3 * estimate.standard_errors)
    assert capsys.readouterr().out == ""


def test_vehicle_finds_the_truth():
    module = runpy.run_path(str(EXAMPLES / "vehicle" / "vehicle.py"))
    estimate = sf.estimate(module["make_problem"]())
    assert estimate.success
    assert estimate.iterations < 12  # the paper's
    np.testing.assert_allclose(estimate.theta, [6.0, 10.0, 0.7], atol=2e-4)


def test_tosses_share_a_friction_coefficient_or_do_not():
    """The first three of the ten."""
    module = runpy.run_path(str(EXAMPLES / "tosses" / "tosses.py"))
    tosses = module["read"]()
    assert len(tosses) == 10
    each = sf.estimate(module["make_problem"](tosses[:3], one_mu=False))
    assert each.success
    # As fits of each toss alone by other software have it.
    np.testing.assert_allclose(list(each.parameters.values()), [0.2162, 0.2153, 0.2034], atol=2e-4)
    one = sf.estimate(module["make_problem"](tosses[:3]), start=module["start_from"](each))
    assert one.success
    assert len(one.theta) == len(each.theta) - 2 == 16
    assert 0.2034 < one.parameters["mu"] < 0.2162
    F, probability = module["is_one_enough"](one, each)
    assert F > 50.0
    assert probability < 1e-6
