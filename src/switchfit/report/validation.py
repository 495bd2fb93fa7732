"""Text and figures of forecasts, of validations on another run, of comparisons of models, and of designs."""

from __future__ import annotations

import numpy as np

from switchfit.experiment_design import Design
from switchfit.fit.trajectory import find_delay
from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import unit_suffix
from switchfit.report import formats, plot, style
from switchfit.report.formats import Table, format_table, join_sections, label_quantity, wrap_quantity, wrap_text
from switchfit.report.sentences import ALLOWED, join_words
from switchfit.report.style import FIT, LINE, LINE_COLOURS, SMALL, THIN, TRANSITION
from switchfit.report.uncertainty import format_probability
from switchfit.runtime.presentation import Axes, Figure, draw_figure, format_text, join_first
from switchfit.strategy.comparison import ModelComparison
from switchfit.strategy.validation import Validation, convert_to_percent
from switchfit.uncertainty.prediction import Prediction
from switchfit.uncertainty.residuals import explain_channel, list_channels

# --- forecasts --------------------------------------------------------------------------------------------------------


@draw_figure.register(Prediction)
def plot_prediction(prediction: Prediction, *, level: float = 0.95) -> Figure:
    """Draw each output over time with its bands, what was measured, the modes, and where the data end.

    Parameters
    ----------
    prediction : Prediction
    level : float, between 0 and 1
    """
    outputs = plot.list_outputs(prediction.fit, prediction.experiment)
    trajectory, order = prediction.fit.trajectories[prediction.experiment], np.argsort(prediction.times, kind="stable")
    times, values = prediction.times[order], prediction.outputs if prediction.output_names else prediction.states
    begin, end = trajectory.mode_spans[0][1], trajectory.mode_spans[-1][2]
    figure = style.make_figure(8.0, 0.9 + 2.6 * len(outputs))
    axes = figure.subplots(len(outputs), 1, sharex=True, squeeze=False)[:, 0]
    for number, ((comparison, k), ax) in enumerate(zip(outputs, axes, strict=True)):
        plot.plot_bands(prediction, number, level, ax)
        late = find_delay(comparison, trajectory)
        ax.plot(times + late, values[order, number], "-", color=FIT, linewidth=LINE, zorder=4, label="predicted")
        plot.draw_measured(comparison, comparison.times, comparison.measured[:, k], ax)
        plot.plot_modes(trajectory, ax, labels=ax is axes[0])
        if times[-1] > end:
            colour = plot.choose_mode_colours([trajectory])[trajectory.mode_spans[-1][0]]
            ax.axvspan(end, times[-1], color=colour, linewidth=0, zorder=0)
            ax.axvline(end, color=TRANSITION, linestyle="--", linewidth=THIN, zorder=2, label="end of the data")
        style.label_axis(ax, prediction)
        ax.set_xlim(min(times[0], begin), max(times[-1], end))
        ax.set_ylabel(wrap_quantity(comparison.names[k], comparison.units[k]))
        ax.label_outer()
    figure.draw_legend(style.collect_handles(axes), loc="outside upper right")
    return style.turn_off_formulas(figure)


# --- validation -------------------------------------------------------------------------------------------------------


@format_text.register(Validation)
def write_validation(found: Validation) -> str:
    """Return the verdict, what was kept and what was estimated, and a row for each channel.

    Parameters
    ----------
    found : Validation
    """
    errors, names, rows = found.corrected_standard_errors, found.theta_names, []
    refit = () if found.refit is None else found.refit.theta_names
    known = zip(names, found.theta, errors, found.problem.unknowns.units, strict=True)
    for (name, value, error, unit), run in zip(known, formats.list_dated(found.problem), strict=True):
        shown, spread = formats.format_estimate(float(value), float(error), run)
        origin = "estimated from this run" if name in refit else "as given"
        origin = "kept from the fit" if name in found.kept else origin
        rows.append([name, shown, spread if spread != "held" else "", unit, origin])
    sections = [wrap_text(str(found.verdict)), format_table(rows, "<>><<")]
    if not np.array_equal(errors, found.standard_errors, equal_nan=True):
        sections.append([ALLOWED])
    sections.append(["Channels", *format_table(*tabulate_predicted(found))])
    if np.isfinite(found.chi_square):
        kind = "" if np.isinf(found.noise_freedom) else f", F with {found.freedom} and {found.noise_freedom:.4g}"
        chi_square = f"chi² {found.chi_square:.4g} for {found.freedom} degrees of freedom"
        sections.append([f"{chi_square}, the error of the parameters included: P = {found.probability:.2g}{kind}"])
    if found.inputs:
        tests = [(test.channel, test.input, format_probability(test.probability)) for test in found.inputs]
        columns = ["residuals of", "and input", "P(none)"]
        sections.append(["Correlation with inputs", *format_table(tests, "<<>", columns)])
    return join_sections(*sections)


def tabulate_predicted(found: Validation) -> Table:
    """Return a row for each channel: how much of it is predicted, and the tests of its residuals.

    Parameters
    ----------
    found : Validation
    """
    rows, titles = [], ["", "values", "fit (%)", "R²", "rms error", "lag 1", "P(white)"]
    tests = dict(zip(found.residuals.labels, found.residuals.channels, strict=True))
    for label, _, comparison, k in list_channels(found.comparisons, found.run_names):
        explained, test = explain_channel(comparison, k), tests.get(label)
        white = "" if test is None else format_probability(test.whiteness)
        count = int(np.isfinite(comparison.measured[:, k]).sum())
        shares = [f"{convert_to_percent(explained):.1f}", f"{explained:.4f}"]
        lag = "" if test is None else f"{test.correlation:+.2f}"
        rows.append([label, f"{count}", *shares, f"{comparison.rmse[k]:.3g}", lag, white])
    return Table(rows, "<" + ">" * 6, titles)


@draw_figure.register(Validation)
def plot_validation(found: Validation, *, level: float = 0.95) -> Figure:
    """Draw measured against predicted for each channel with bands, and the residuals below.

    Parameters
    ----------
    found : Validation
        Of more than ten runs the first ten are shown.
    level : float, between 0 and 1
    """
    runs = range(min(len(found.comparisons), plot.LARGEST_FIGURE))
    intervals = {e: _find_intervals(found, e, level) for e in runs}
    figure = plot.plot_runs(found, intervals, dict(enumerate(found.predictions)), level=level, label="predicted")
    for e, block in enumerate(figure.subfigs):
        for panel, (comparison, k) in zip(block.axes[::2], plot.list_outputs(found, e), strict=False):
            text = f"fit {convert_to_percent(explain_channel(comparison, k)):.1f} %"
            panel.annotate(text, (0.01, 0.97), xycoords="axes fraction", va="top", fontsize=SMALL)
    return figure


def _find_intervals(found: Validation, e: int, level: float) -> FloatArray:
    """Return the interval of each transition time of one run, NaN where it is not estimated: (N, 2)."""
    transitions = [begin for _, begin, _ in found.trajectories[e].mode_spans[1:]]
    places = found.problem.unknowns.times[e][: len(transitions)]
    half = found.quantile(level) * np.append(found.corrected_standard_errors, np.nan)[places]  # the last: not estimated
    return np.stack([transitions - half, transitions + half], axis=-1)


# --- comparison of models ---------------------------------------------------------------------------------------------


@format_text.register(ModelComparison)
def write_comparison(found: ModelComparison) -> str:
    """Return what is best, and a row for each model.

    Parameters
    ----------
    found : ModelComparison
    """
    lines = format_table(*tabulate_models(found))
    ended = [name for name, fit in zip(found.names, found.estimates, strict=True) if not fit.status.successful]
    if ended:
        lines += wrap_text(f"Not converged: {', '.join(ended)}. Likelihoods of these may be too small.", "  ")
    return join_sections(wrap_text(write_best(found)), lines)


_STRENGTHS = ((10.0, "very strong"), (6.0, "strong"), (2.0, "positive"), (0.0, "weak"))
"""Words of Kass and Raftery (1995) for differences in BIC."""
SAME = 0.05
"""Difference in BIC below which models are as good as each other: it would be printed as 0.0."""


def write_best(found: ModelComparison) -> str:
    """Return which model has the smallest BIC and how strong that evidence is, or which models are equally good.

    Parameters
    ----------
    found : ModelComparison
    """
    order = _list_best_first(found)
    best = [k for k in order if found.delta_bic[k] < SAME]
    are_best = "has the smallest BIC" if len(best) == 1 else "are as good as each other by BIC"
    text = f"{join_words([found.names[k] for k in best])} {are_best}"
    if len(best) < len(order):
        k = order[len(best)]
        strength = next(word for least, word in _STRENGTHS if found.delta_bic[k] >= least)
        text += f", {found.delta_bic[k]:.1f} below {found.names[k]}: {strength} evidence"
    return f"{text}. {found.values} values."


def tabulate_models(found: ModelComparison) -> Table:
    """Return a row for each model: unknowns, likelihood, AICc and BIC, the best first.

    Parameters
    ----------
    found : ModelComparison
    """
    rows, titles = [], ["", "unknowns", "log L", "AICc", "delta AICc", "weight", "BIC", "delta BIC"]
    for k in _list_best_first(found):
        aicc = [f"{found.aicc[k]:.2f}", f"{found.delta_aicc[k]:.2f}", f"{found.weights[k]:.2g}"]
        bic = [f"{found.bic[k]:.2f}", f"{found.delta_bic[k]:.2f}"]
        rows.append([found.names[k], f"{found.unknown_counts[k]}", f"{found.log_likelihood[k]:.2f}", *aicc, *bic])
    return Table(rows, "<" + ">" * 7, titles)


def _list_best_first(found: ModelComparison) -> list[int]:
    return np.argsort(found.bic, kind="stable").tolist()


MEANING = {"D": "log det", "A": "trace", "E": "largest eigenvalue"}
"""What of the covariance a criterion is."""

POINTS = 1000
"""Times at which an input is drawn."""


@format_text.register(Design)
def write_design(design: Design) -> str:
    """Return standard errors and criterion before and after, what cannot be estimated, the input and the samples.

    Parameters
    ----------
    design : Design
    """
    path, units = design.trajectory, design.problem.unknowns.units
    columns = (design.theta_names, units, design.theta, design.standard_errors_before, design.standard_errors)
    rows, titles = [], ["unknown", "value", "standard error as given", "as designed", ""]
    for name, unit, value, *errors in zip(*columns, strict=True):
        before, after = ("none" if np.isnan(error) else f"{error:.3g}" for error in errors)
        rows.append((name, f"{value:.6g}", before, after, unit_suffix(unit).strip()))
    before, after = (f"{value:.4g}" for value in (design.criterion_before, design.criterion_after))
    rows.append((f"{MEANING[design.criterion]} of covariance", "", before, after, ""))
    head = f"{design.criterion}-optimal design of {design.run} for {join_first(design.names)}."
    texts = [
        template.format(", ".join(names))
        for names, template in ((design.undetermined, _UNDETERMINED), (design.doubtful, _DOUBTFUL))
        if names
    ]
    for name, values in design.inputs.items():
        texts.append(f"{name} at {len(values)} knots: {', '.join(f'{value:.4g}' for value in values)}")
    for sensor, times in design.sample_times.items():
        listed = ", ".join(formats.format_time(time, path) for time in times.tolist()) + formats.suffix_time(path)
        texts.append(f"{sensor}: {len(times)} of {len(design.shares[sensor])} samples, at {listed}")
    return join_sections(wrap_text(head), format_table(rows, "<>>><", titles), *map(wrap_text, texts))


_UNDETERMINED = (
    "This experiment cannot determine {}, whatever is measured: no sample depends on it, or only as on another "
    "unknown. Measure something else or at other times, let an input act, give a prior, or fix what is known."
)
_DOUBTFUL = (
    "The standard error of {} is larger than the distance to a bound or to the next transition, so that a fit is far "
    "from linear. Refits of simulated data, sf.monte_carlo(design.problem), say what will be known; a prior or another "
    "input may help."
)


@draw_figure.register(Design)
def plot_design(design: Design) -> Figure:
    """Draw the input as given and as designed, the states, and the share of the information of each sample.

    Parameters
    ----------
    design : Design
    """
    path, units = design.trajectory, dict.fromkeys(design.trajectory.state_units)
    count = bool(design.inputs) + len(units) + 1
    figure = style.make_figure(8.0, 0.8 + 1.7 * count)
    axes = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0].tolist()
    if design.inputs:
        _draw_inputs(design, axes[0])
    for ax, unit in zip(axes[-len(units) - 1 :], units, strict=False):
        names = [name for name, own in zip(path.state_names, path.state_units, strict=True) if own == unit]
        for name, colour in style.assign_colours(names, LINE_COLOURS).items():
            ax.plot(path.times, path.states[:, path.state_names.index(name)], color=colour, linewidth=LINE, label=name)
        ax.set_ylabel(label_quantity(", ".join(names), unit))
    times = [item.times for item in design.given.experiments[design.experiment].data]
    colours = style.assign_colours(design.shares, LINE_COLOURS)
    for when, (name, shares) in zip(times, design.shares.items(), strict=True):
        taken = np.isin(when, design.sample_times.get(name, ()))
        axes[-1].vlines(when[taken], 0.0, shares[taken], color=colours[name], linewidth=LINE)
        axes[-1].plot(when[taken], shares[taken], "o", markersize=4, color=colours[name], label=name)
        axes[-1].plot(when[~taken], shares[~taken], "o", markersize=3, color=colours[name], fillstyle="none")
    axes[-1].set_ylabel("share of information")
    for ax in axes:
        plot.plot_modes(path, ax, labels=ax is axes[0])
        ax.label_outer()
        if len(ax.get_legend_handles_labels()[0]) > 1:
            ax.legend(loc="best", frameon=False, fontsize=SMALL)
    return style.turn_off_formulas(figure)


def _draw_inputs(design: Design, ax: Axes) -> None:
    """Draw each entry of the input, dashed as it was given."""
    for problem, line, width in ((design.given, "--", THIN), (design.problem, "-", LINE)):
        run = problem.experiments[design.experiment]
        times = np.linspace(design.trajectory.times[0], design.trajectory.times[-1], POINTS)
        values = run.inputs.signal(run.t0, run.end)(times)
        colours = style.assign_colours(design.inputs, LINE_COLOURS)
        for (name, colour), curve in zip(colours.items(), values.T, strict=True):
            ax.plot(times, curve, line, color=colour, linewidth=width, label=name if line == "-" else None)
    ax.set_ylabel("input")
