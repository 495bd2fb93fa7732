"""What a user writes, of which mypy has no complaint, runs: `tests/typing_user.py`."""

import matplotlib
import numpy as np
import pytest
import typing_user

import switchfit as sf

matplotlib.use("agg")


@pytest.mark.slow
def test_it_runs(tmp_path):
    found = typing_user.use(typing_user.make_problem(), tmp_path)
    assert all(type(number) is float for number in found)


def test_what_is_given_and_found_is_of_the_types_that_annotations_say():
    """What is read from the objects does not depend on what was given, and cannot be changed behind their backs."""
    problem = typing_user.make_problem()
    (run,) = problem.experiments
    for given in (run.mode_sequence, run.transition_times, problem.system.state_names, run.data[0].names):
        assert type(given) is tuple
    assert sf.Experiment(run.data[0], ["on"]).transition_times == ()
    estimate = sf.estimate(problem, strategy="local")
    assert type(estimate.parameters["power"]) is float
    np.testing.assert_array_equal(estimate.parameters["unused"], [1.0, 2.0])
