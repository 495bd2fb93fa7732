"""Tests of the residuals, against SciPy and the textbook."""

import numpy as np
import pytest
import scipy.signal
import scipy.stats

import switchfit as sf
from support.fits_by_hand import comparison_of, made, trajectory_of, warnings_of
from support.models import STILL
from switchfit.uncertainty.residuals import correct_correlation, diagnose_channel

# Residuals


def diagnostics_of(residual, sigma=0.1):
    trajectory = trajectory_of()
    comparison = comparison_of(trajectory, samples=len(residual), names=("X", "h"), sigma=sigma)
    comparison.measured[:] = comparison.fitted + np.asarray(residual)[:, None]
    return comparison


def test_residuals_against_scipy_and_the_textbook():
    rng = np.random.default_rng(0)
    residual = 0.1 * rng.standard_normal(200)
    found = diagnose_channel(diagnostics_of(residual), 0)
    z = residual / 0.1
    r = [np.sum(z[k:] * z[:-k]) / np.sum(z**2) for k in range(1, 11)]
    np.testing.assert_allclose(found.autocorrelation, r, rtol=1e-9)
    Q = 200 * 202 * sum(value**2 / (200 - k) for k, value in enumerate(r, start=1))
    assert found.whiteness == pytest.approx(scipy.stats.chi2.sf(Q, 10), rel=1e-9)
    assert found.rms == pytest.approx(np.sqrt(np.mean(z**2)), rel=1e-12)
    assert found.white


def test_correlated_residuals_are_worth_fewer():
    shocks = 0.08 * np.random.default_rng(2).standard_normal(2000)
    residual = scipy.signal.lfilter([1.0], [1.0, -0.6], shocks)
    found = diagnose_channel(diagnostics_of(residual), 0)
    assert not found.white
    assert found.correlation == pytest.approx(0.6, abs=0.05)
    assert found.effective == pytest.approx(2000 * 0.4 / 1.6, rel=0.15)
    (warning,) = warnings_of(made(comparisons=((diagnostics_of(residual),),), cost=2000.0, sigma_known=False))
    assert f"too small by a factor of up to {found.narrowing:.2g}." in warning


@pytest.mark.parametrize(("r", "d"), [(0.5, 1), (0.8, 1), (0.8, 3), (0.6, 5)])
def test_the_correlation_of_noise_follows_from_that_of_residuals(r, d):
    """Of polynomials fitted to noise of a first-order process: without its bias to a fifth of it."""
    n, runs = 200, 3000
    shocks = np.random.default_rng(d).standard_normal((runs, n + 100))
    noise = scipy.signal.lfilter([1.0], [1.0, -r], shocks, axis=1)[:, 100:]
    basis = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, n), d - 1))[0]
    z = noise - (noise @ basis) @ basis.T
    first = np.sum(z[:, 1:] * z[:, :-1], axis=1) / np.sum(z**2, axis=1)
    bias = r - first.mean()
    assert bias == pytest.approx((3 * r + d * (1 + r)) / n, rel=0.15)
    assert abs(np.mean([correct_correlation(one, n, d) for one in first]) - r) < 0.2 * bias


def test_the_correction_of_the_correlation_keeps_within_limits():
    assert correct_correlation(0.5, 40, 8) == pytest.approx((40 - 9) / (40 + 9)), "worth one value more than unknowns"
    assert correct_correlation(0.95, 40, 8) == 0.95, "never less than that of the residuals"
    assert correct_correlation(-0.1, 40, 8) == -0.1
    assert correct_correlation(1.0, 40, 8) == 0.999
    assert correct_correlation(0.5, 10**6, 3) == pytest.approx(0.5, abs=1e-5)


def test_a_cost_without_measurements_has_no_residuals():
    cost = sf.TerminalCost(lambda x, p: (p["a"] - 1.0) ** 2)
    none = sf.estimate(sf.Problem(STILL, sf.Experiment(cost, ("still",), (), 0.0, 1.0), {"a": 2.0}))
    assert str(none.residuals) == "No residuals: the cost has no Measurements."


def test_a_channel_met_exactly_and_a_short_one():
    exact = diagnose_channel(diagnostics_of(np.zeros(30), sigma=None), 0)
    assert (exact.white, exact.outliers) == (True, 0)
    short = diagnose_channel(diagnostics_of(np.ones(4)), 0)
    assert np.isnan(short.whiteness)
