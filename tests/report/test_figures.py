"""Plots: what is drawn equals the numbers, labels have units, and one rule for axes holds for all of them."""

import csv
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

import switchfit as sf
from switchfit.cli.tables import write_unknowns
from switchfit.models import heater_problem
from switchfit.report.style import FIT_COLOUR, TRANSITION_COLOUR, turn_off_formulas

pytestmark = pytest.mark.usefixtures("fits_one_by_one")


def straight(t, x, p):
    return jnp.stack([p["v"] * jnp.cos(x[2]), p["v"] * jnp.sin(x[2]), 0.0 * x[2]])


def turn(t, x, p):
    return jnp.stack([p["v"] * jnp.cos(x[2]), p["v"] * jnp.sin(x[2]), p["w"] + 0.0 * x[2]])


CAR = sf.HybridSystem({"straight": straight, "turn": turn}, initial_state=[0.0, 0.0, 0.3])
TIMES = np.linspace(0.25, 20.0, 80)


def drive(values, guess=(6.0, 13.0), **settings) -> sf.Problem:
    """A car drives straight on, turns and drives straight on."""
    data = sf.Measurements(
        TIMES, values, observe=lambda t, x, p: x[jnp.array([0, 1])], sigma=0.3, names=("east", "north"), **settings
    )
    run = sf.Experiment(data, ("straight", "turn", "straight"), guess, 0.0, 20.0, time_unit="s")
    limits = {"v": sf.Parameter(1.5, lower=0.1, upper=2.0, unit="m/s"), "w": sf.Parameter(0.2, lower=0.0, unit="rad/s")}
    return sf.Problem(CAR, run, limits)


@pytest.fixture(scope="module")
def car() -> sf.Estimate:
    path = sf.simulate(drive(np.zeros((80, 2))), [7.0, 12.0, 1.8, 0.35])
    exact = np.stack([np.interp(TIMES, path.times, path.states[:, k]) for k in (0, 1)], axis=1)
    noise = 0.3 * np.random.default_rng(1).standard_normal((80, 2))
    return sf.estimate(drive(exact + noise, units=("m", "m")), strategy="local")


@pytest.fixture(scope="module")
def starts() -> sf.Multistart:
    return sf.multistart(heater_problem(), 8)


PLOTS = {
    "convergence": lambda car, starts, **ax: car.plot_convergence(**ax),
    "timeline": lambda car, starts, **ax: car.plot_timeline(**ax),
    "plane": lambda car, starts, **ax: car.plot_plane(**ax),
    "profile": lambda car, starts, **ax: car.profile("v").plot(**ax),
    "waterfall": lambda car, starts, **ax: starts.plot(**ax),
}


@pytest.mark.parametrize("name", PLOTS)
def test_axes_given_are_drawn_in_and_returned_and_a_figure_is_made_without(name, car, starts):
    """A figure that a notebook shows."""
    ax = Figure().subplots()
    assert PLOTS[name](car, starts, ax=ax) is ax
    assert ax.has_data()
    figure = PLOTS[name](car, starts)
    with pytest.raises(TypeError, match="ax must be a matplotlib Axes; got NotebookFigure"):
        PLOTS[name](car, starts, ax=figure)
    assert figure._repr_png_()[:4] == b"\x89PNG"


def test_the_unit_of_a_channel_that_is_left_out_is_that_of_the_state_of_the_same_name():
    data = sf.Measurements([0.5, 1.0, 1.5], [0.5, 1.0, 1.4], names=("T",))
    system = sf.HybridSystem({"on": lambda t, x, p: p["a"] + 0 * x}, [0.0], state_names=("T",), state_units=("K",))
    fit = sf.estimate(sf.Problem(system, sf.Experiment(data, ("on",), (), 0.0, 2.0), {"a": 1.0}), strategy="local")
    assert fit.plot().axes[0].get_ylabel() == "T (K)"


# --- units ------------------------------------------------------------------------------------------------------------


# --- over time --------------------------------------------------------------------------------------------------------


def test_figures_shade_the_interval_of_the_table():
    """Of a fit whose residuals are correlated, so that its naive standard errors are several times too small."""
    problem = heater_problem()
    (run,) = problem.experiments
    drift = scipy.signal.lfilter([0.2], [1.0, -0.95], np.random.default_rng(4).standard_normal(200))
    times = np.linspace(run.t0 + 0.01, run.tf, 200)
    clean = sf.predict(sf.estimate(problem), times=times).outputs[:, 0]
    log = replace(run.data[0], times=times, values=(clean + drift)[:, None], sigma=None)
    fit = sf.estimate(replace(problem, experiments=[replace(run, data=log)]))
    (row,) = (row for row in csv.DictReader(write_unknowns(fit).splitlines()) if row["unknown"] == "tau_1")
    table, naive = [float(row["low"]), float(row["high"])], fit.confidence_intervals()[0]
    assert table[1] - table[0] > 1.5 * (naive[1] - naive[0])
    (band,) = (patch for patch in fit.plot().axes[0].patches if to_hex(patch.get_facecolor()) == TRANSITION_COLOUR)
    np.testing.assert_allclose((band.get_x(), band.get_x() + band.get_width()), table)
    line = next(line for line in fit.plot_timeline().axes[0].lines if to_hex(line.get_color()) == FIT_COLOUR)
    np.testing.assert_allclose(line.get_xdata(), table)


# --- in the plane -----------------------------------------------------------------------------------------------------


def test_path_in_the_plane(car, heater):
    """Its channels can be named, and must exist."""
    ax = car.plot_plane().axes[0]
    comparison = car.comparisons[0][0]
    dots, *modes, transitions = ax.lines
    np.testing.assert_array_equal(np.transpose(dots.get_data()), comparison.measured)
    path = np.concatenate([np.transpose(line.get_data()) for line in modes])
    np.testing.assert_array_equal(path, comparison.curve)
    at = [np.interp(t, car.trajectory.times, car.trajectory.states[:, 0]) for t in car.transition_times[0]]
    np.testing.assert_allclose(transitions.get_xdata(), at)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("east (m)", "north (m)")
    assert car.plot_plane(channels=("north", "east")).axes[0].get_xlabel() == "north (m)"
    for fit, channels, message in (
        (car, ("up", "east"), r"no two channels of the same data are .*they are .?east.?, .?north"),
        (heater, None, "no two channels of the same data are positions in a plane"),
        (car, ("east",), "channels must be two names; got"),
        (car, 5, "channels must be"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            fit.plot_plane(channels=channels)


# --- of many starts ---------------------------------------------------------------------------------------------------


# --- one line ---------------------------------------------------------------------------------------------------------


def test_every_result_is_one_line(heater, starts):
    problem, run = heater.problem, heater.problem.experiments[0]
    for result in (
        heater.profile("k"), heater.predict([1.0]), heater.comparisons[0][0], heater.residuals, heater.certificate,
        heater.identifiability, heater.verdict, heater.termination, sf.check_derivatives(problem), run, run.data[0],
        problem.system, sf.Input([0.0, 1.0], [[0.0], [1.0]]), heater.steps, heater.trajectory,
        sf.ReferenceSignal.from_samples(np.arange(5.0), np.zeros((5, 1))),
        sf.Log(np.arange(3.0), {"x": np.arange(3.0)}, {"x": "m"}, "s", "log.csv"),
    ):  # fmt: skip
        assert "\n" not in repr(result)
        assert len(repr(result)) < 500
    assert repr(heater) == "Estimate(good, J = 6.03062, tau_1 = 2.462, k = 0.3931)"
    known = dict(heater.problem.parameters) | {"k": sf.Parameter(0.45, fixed=True)}
    models = sf.compare([sf.estimate(replace(heater.problem, parameters=known)), heater], names=("k known", "k free"))
    assert repr(models) == "ModelComparison(k known (BIC +105), k free (BIC +0), 24 values)"
    assert repr(heater.validate(problem)) == "Validation(good, fit of thermometer 96.2 %)"
    assert repr(starts) == "Multistart(8 fits, 8 good, tau_1, k)"
    assert repr(problem) == "Problem(1 experiment, unknowns tau_1, k)"


def test_figures_of_several_panels(heater, starts):
    """What a notebook shows of fits, studies, validations and forecasts."""
    found = heater.validate(heater.problem)
    (prediction,) = found.predictions
    reach = np.abs(prediction.prediction_band()[:, 0] - prediction.outputs).max()
    validation = found.plot()
    assert validation.axes[1].get_ylim()[0] < -reach, "the band about the residuals' zero is cut off"
    assert validation.axes[1].get_ylim()[1] > reach
    labels = {text.get_text() for text in validation.legends[0].get_texts()}
    assert {"measured", "predicted", "95 % prediction", "95 % confidence", "± sigma"} < labels
    fits = sf.estimate_many([heater.problem] * 3).plot()
    assert [ax.get_ylabel() for ax in fits.axes] == ["run", ""]
    assert [text.get_text() for text in fits.legends[0].get_texts()] == ["good"]
    studies = (sf.bootstrap(starts.best, 5), sf.monte_carlo(heater.problem, 5, theta=[2.5, 0.4]))
    forecast = heater.predict(np.linspace(0.0, 9.0, 30)).plot()
    for figure in (validation, fits, forecast, *(study.plot() for study in studies)):
        assert all(ax.has_data() for ax in figure.axes)
        assert figure._repr_png_()[:4] == b"\x89PNG"


def test_an_interval_that_is_far_longer_than_the_others_is_cut_off(heater):
    fits = sf.estimate_many([heater.problem] * 3)
    far = np.array([1.0, 1.0, 1e160])[:, None, None]
    left, right = replace(fits, covariance=fits.covariance * far).plot().axes[1].get_xlim()
    assert left < fits.confidence_intervals()[0, 1, 0] + 1e-9
    assert right - left == pytest.approx(np.ptp(fits.confidence_intervals()[0, 1]), rel=0.2)


def test_a_marker_covers_no_name_in_the_timeline(heater):
    ax = heater.plot_timeline().axes[0]
    ax.figure.draw_without_rendering()
    (marker,) = ax.lines
    assert all(marker.get_window_extent().y1 < text.get_window_extent().y0 for text in ax.texts)


def test_names_with_dollars_are_no_formulas():
    figure = Figure()
    name, tick = figure.text(0.1, 0.1, "price $k$ of $m$"), figure.text(0.2, 0.2, r"$\mathdefault{10^{1}}$")
    turn_off_formulas(figure)
    assert not name.get_parse_math()
    assert tick.get_parse_math()


def test_a_long_name_of_a_channel_is_not_wider_than_its_panel(heater):
    (run,) = heater.problem.experiments
    data = replace(run.data[0], names=("temperature of the pipe in the cellar behind the boiler",))
    fit = sf.estimate(replace(heater.problem, experiments=replace(run, data=data)))
    for figure in (fit.plot(), fit.plot_residuals()):
        figure.draw_without_rendering()
        ax = figure.axes[0]
        assert ax.yaxis.label.get_window_extent().height < ax.bbox.height
