"""Text and figures of forecasts, of validations on another run, and of comparisons of models."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from switchfit.problem.data import FloatArray
from switchfit.report.numbers import format_rounded
from switchfit.report.plot import (
    LARGEST_FIGURE,
    Bands,
    choose_mode_colours,
    plot_band,
    plot_comparison,
    plot_modes,
    plot_residuals,
    plot_transitions,
)
from switchfit.report.style import DATA, FIT, TRANSITION, turn_off_formulas
from switchfit.report.tables import format_table, wrap_text
from switchfit.runtime.presentation import draw_figure, format_text
from switchfit.strategy.comparison import ModelComparison
from switchfit.strategy.validation import Validation, convert_to_percent
from switchfit.uncertainty.prediction import Prediction
from switchfit.uncertainty.quality import explain_channel

BLUE = "#4a7fb5"

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# --- forecasts --------------------------------------------------------------------------------------------------------


@draw_figure.register(Prediction)
def plot_prediction(prediction: Prediction, *, level: float = 0.95) -> Figure:
    """Draw each output over time with its bands, what was measured, the modes, and where the data end.

    Parameters
    ----------
    prediction : Prediction
    level : float, between 0 and 1
    """
    from matplotlib.figure import Figure

    fit, e = prediction.fit, prediction.experiment
    order = np.argsort(prediction.times, kind="stable")
    times = prediction.times[order]
    trajectory = fit.trajectories[e]
    spans = trajectory.mode_spans
    colours = choose_mode_colours([trajectory])
    channels = [(c, k) for c in fit.comparisons[e] for k in range(len(c.names))]
    figure = Figure(figsize=(8.0, 0.9 + 2.6 * len(channels)), layout="constrained")
    axes = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
    quantile, end = fit.quantile(level), spans[-1][2]
    low, high = min(float(times[0]), spans[0][1]), max(float(times[-1]), end)
    for number, (ax, (comparison, k)) in enumerate(zip(axes, channels, strict=True)):
        y, error = prediction.outputs[order, number], prediction.output_errors[order, number]
        noise = prediction.noise[order, number]
        for half, alpha, label in ((np.hypot(error, noise), 0.12, "prediction"), (error, 0.3, "confidence")):
            ax.fill_between(
                times, y - quantile * half, y + quantile * half, color=FIT, alpha=alpha, linewidth=0, zorder=2,
                label=f"{100 * level:g} % {label}",
            )  # fmt: skip
        ax.plot(times, y, "-", color=FIT, linewidth=1.5, zorder=4, label="predicted")
        size = 4.5 if len(comparison.times) <= 100 else 2.0
        ax.plot(comparison.times, comparison.measured[:, k], "o", color=DATA, markersize=size, markeredgewidth=0,
                zorder=3, label="measured")  # fmt: skip
        for mode, first, last in spans:
            to = high if last == end else last
            ax.axvspan(first, to, color=colours[mode], linewidth=0, zorder=0)
            if number == 0 and to > first:
                ax.text((first + to) / 2, 1.02, mode, transform=ax.get_xaxis_transform(), ha="center", fontsize=9)
        if high > end:
            ax.axvline(end, color=TRANSITION, linestyle="--", linewidth=1.0, zorder=2, label="end of the data")
        ax.set_xlim(low, high)
        ax.set_ylabel(comparison.names[k])
    from switchfit.report.date_axis import label_axis

    label_axis(axes[-1], prediction)
    _draw_legend(figure, axes)
    return turn_off_formulas(figure)


def _draw_legend(figure: Figure, axes: Iterable[Axes]) -> None:
    handles: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(
        handles.values(), handles.keys(), loc="outside upper right", ncols=min(len(handles), 5), frameon=False
    )


# --- validation -------------------------------------------------------------------------------------------------------


@format_text.register(Validation)
def write_validation(found: Validation) -> str:
    """Return the verdict, what was kept and what was estimated, and a row for each channel.

    Parameters
    ----------
    found : Validation
    """
    lines = wrap_text(str(found.verdict))
    own = [i for i, name in enumerate(found.theta_names) if name not in found.kept]
    units = found.problem.unknowns.units
    errors = found.standard_errors

    def list_unknowns(places: Sequence[int]) -> list[list[str]]:
        rows = []
        for i in places:
            value, error, _ = format_rounded(float(found.theta[i]), float(errors[i]))
            rows.append([found.theta_names[i], value, error if error != "held" else "", units[i]])
        return rows

    estimated = [i for i in own if found.refit is not None and found.theta_names[i] in found.refit.theta_names]
    given = [i for i in own if i not in estimated]
    for title, places in (
        ("Kept from the fit", [found.theta_names.index(name) for name in found.kept]),
        ("Estimated from this run", estimated),
        ("As given", given),
    ):
        if places:
            lines += ["", title, *format_table(list_unknowns(places), "<>><")]
    lines += ["", "Channels", *format_table(_tabulate_channels(found), "<" + ">" * 6)]
    if np.isfinite(found.chi_square):
        kind = "" if found.sigma_known else f", F with {found.freedom} and {found.fit.freedom}"
        lines += [
            "",
            f"chi² {found.chi_square:.4g} for {found.freedom} degrees of freedom, the error of the parameters "
            f"included: P = {found.probability:.2g}{kind}",
        ]
    if found.inputs:
        rows = [["residuals of", "and input", "P(none)"]]
        rows += [[t.channel, t.input, "-" if np.isnan(t.probability) else f"{t.probability:.2g}"] for t in found.inputs]
        lines += ["", "Correlation with inputs", *format_table(rows, "<<>")]
    return "\n".join(lines)


def _tabulate_channels(found: Validation) -> list[list[str]]:
    rows = [["", "values", "fit (%)", "R²", "rms error", "lag 1", "P(white)"]]
    tests = dict(zip(found.residuals.labels, found.residuals.channels, strict=True))
    single = len(found.comparisons) == 1
    for run, comparisons in zip(found.run_names, found.comparisons, strict=True):
        for comparison in comparisons:
            rmse = comparison.rmse
            for k, name in enumerate(comparison.names):
                label = name if single else f"{run} {name}"
                explained, test = explain_channel(comparison, k), tests.get(label)
                white = "" if test is None or np.isnan(test.whiteness) else f"{test.whiteness:.2g}"
                rows.append(
                    [
                        label,
                        f"{int(np.isfinite(comparison.measured[:, k]).sum())}",
                        f"{convert_to_percent(explained):.1f}",
                        f"{explained:.4f}",
                        f"{rmse[k]:.3g}",
                        "" if test is None else f"{test.correlation:+.2f}",
                        white,
                    ]
                )
    return rows


@draw_figure.register(Validation)
def plot_validation(found: Validation, *, level: float = 0.95) -> Figure:
    """Draw measured against predicted for each channel with bands, and the residuals below.

    Parameters
    ----------
    found : Validation
        Of more than ten channels the first ten are shown.
    level : float, between 0 and 1
    """
    from matplotlib.figure import Figure

    panels = [
        (e, c, k, before + k)
        for e, run in enumerate(found.comparisons)
        for c, before in zip(run, np.cumsum([0, *(len(c.names) for c in run)]).tolist(), strict=False)
        for k in range(len(c.names))
    ][:LARGEST_FIGURE]
    figure = Figure(figsize=(8.0, 1.0 + 2.9 * len(panels)), layout="constrained")
    axes = figure.subplots(2 * len(panels), 1, squeeze=False, height_ratios=[3.0, 1.2] * len(panels))[:, 0]
    colours = choose_mode_colours(found.trajectories)
    intervals = [_find_intervals(found, e, level) for e in range(len(found.trajectories))]
    bands = [Bands.of(prediction, found.quantile(level), level) for prediction in found.predictions]
    for number, (e, comparison, k, channel) in enumerate(panels):
        ax, below = axes[2 * number : 2 * number + 2]
        trajectory = found.trajectories[e]
        plot_comparison(comparison, trajectory, k, ax)
        ax.lines[-1].set_label("predicted")
        plot_residuals(comparison, trajectory, k, below)
        if bands:
            fitted = bands[e].outputs[:, channel].mean(axis=1, keepdims=True)
            for about, panel in ((0.0, ax), (fitted, below)):
                for band, alpha, label in (
                    (bands[e].predicted, 0.12, "prediction"),
                    (bands[e].outputs, 0.3, "confidence"),
                ):
                    text = f"{100 * level:g} % {label}"
                    plot_band(bands[e], band[:, channel] - about, panel, alpha=alpha, label=text)
        transitions = [begin for _, begin, _ in trajectory.mode_spans[1:]]
        for panel in (ax, below):
            plot_modes(trajectory, panel, colours=colours, labels=panel is ax)
            plot_transitions(transitions, intervals[e], panel)
        ax.tick_params(labelbottom=False)
        ax.set_xlabel("")
        percent = convert_to_percent(explain_channel(comparison, k))
        run = "" if len(found.comparisons) == 1 else f"{found.run_names[e]}: "
        ax.annotate(f"{run}fit {percent:.1f} %", (0.01, 0.97), xycoords="axes fraction", va="top", fontsize=9)
    _draw_legend(figure, axes[::2])
    return turn_off_formulas(figure)


def _find_intervals(found: Validation, e: int, level: float) -> FloatArray:
    """Return the interval of each transition time of one run, NaN where it is not estimated: (N, 2)."""
    transitions = [begin for _, begin, _ in found.trajectories[e].mode_spans[1:]]
    places = found.problem.unknowns.times[e][: len(transitions)]
    half = found.quantile(level) * np.append(found.standard_errors, np.nan)[places]  # -1: not estimated
    return np.stack([transitions - half, transitions + half], axis=-1)


# --- comparison of models ---------------------------------------------------------------------------------------------


@format_text.register(ModelComparison)
def write_comparison(found: ModelComparison) -> str:
    """Return what is best, a row for each model, the likelihood ratios, and the cross-validation.

    Parameters
    ----------
    found : ModelComparison
    """
    order = np.argsort(found.bic, kind="stable")
    first, second = order[:2]
    gap = float(found.bic[second] - found.bic[first])
    strength = next(word for least, word in _STRENGTHS if gap >= least)
    lines = wrap_text(
        f"{found.names[first]} has the smallest BIC, {gap:.1f} below {found.names[second]}: {strength} evidence. "
        f"{found.values} values."
    )
    rows = [["", "unknowns", "log L", "AICc", "delta AICc", "weight", "BIC", "delta BIC"]]
    for k in order.tolist():
        rows.append(
            [
                found.names[k],
                f"{found.unknown_counts[k]}",
                f"{found.log_likelihood[k]:.2f}",
                f"{found.aicc[k]:.2f}",
                f"{found.delta_aicc[k]:.2f}",
                f"{found.weights[k]:.2g}",
                f"{found.bic[k]:.2f}",
                f"{found.delta_bic[k]:.2f}",
            ]
        )
    lines += ["", *format_table(rows, "<" + ">" * 7)]
    ended = [name for name, fit in zip(found.names, found.estimates, strict=True) if not fit.status.successful]
    if ended:
        lines += wrap_text(f"Not converged: {', '.join(ended)}. Likelihoods of these may be too small.", "  ")
    if found.nested:
        rows = [["likelihood ratio", "", "2 log(L/L)", "unknowns", "P"]]
        for pair in found.nested:
            mark = "" if pair.regular else " *"
            p = f"{pair.probability:.2g}{mark}" if pair.statistic >= 0 else "the larger one fits worse: fit it again"
            rows.append([pair.small, f"in {pair.large}", f"{pair.statistic:.2f}", f"{pair.freedom}", p])
        lines += ["", *format_table(rows, "<<>><")]
        if not all(pair.regular for pair in found.nested):
            lines += wrap_text("* too small: if the smaller model is right, a mode of the larger one vanishes.", "  ")
    if found.folds:
        rows = [["runs left out", "-2 log L + 2 own", "", "fit (%)", ""]]
        total, spread = found.held_out.sum(axis=1), found.held_out_percent
        for k in np.argsort(total, kind="stable").tolist():
            least = f"{spread[k].min():.1f} to {spread[k].max():.1f}"
            scores = f"{total[k]:.2f}", f"+{total[k] - total.min():.2f}"
            rows.append([found.names[k], *scores, f"{spread[k].mean():.1f}", least])
        lines += ["", f"Cross-validation, {len(found.folds)} folds", *format_table(rows, "<>>>>")]
    return "\n".join(lines)


_STRENGTHS = ((10.0, "very strong"), (6.0, "strong"), (2.0, "positive"), (0.0, "weak"))
"""Words of Kass and Raftery (1995) for differences in BIC."""


@draw_figure.register(ModelComparison)
def plot_models(found: ModelComparison) -> Figure:
    """Draw the differences in AICc and BIC, the Akaike weights, and the score of runs left out.

    Parameters
    ----------
    found : ModelComparison
    """
    from matplotlib.figure import Figure

    panels = 3 if found.folds else 2
    order = np.argsort(-found.bic, kind="stable")  # the best at the top
    names = [found.names[k] for k in order]
    figure = Figure(figsize=(3.6 * panels + 0.6, 1.3 + 0.42 * len(names)), layout="constrained")
    axes = figure.subplots(1, panels, sharey=True, width_ratios=[1.6, 1.0, 1.2][:panels])
    places = np.arange(len(names))
    axes[0].barh(places + 0.2, found.delta_bic[order], height=0.36, color=FIT, label="BIC")
    axes[0].barh(places - 0.2, found.delta_aicc[order], height=0.36, color=BLUE, label="AICc")
    axes[0].set_xlabel("difference from the smallest")
    _limit_differences(axes[0], np.append(found.delta_bic, found.delta_aicc))
    axes[0].axvline(10.0, color=TRANSITION, linewidth=0.8, linestyle=":")
    axes[0].set_yticks(places, names)
    axes[0].legend(frameon=False, fontsize=9)
    axes[1].barh(places, found.weights[order], height=0.5, color=BLUE)
    axes[1].set_xlim(0.0, 1.0)
    axes[1].set_xlabel("Akaike weight")
    if found.folds:
        total = found.held_out.sum(axis=1)
        axes[2].barh(places, (total - total.min())[order], height=0.5, color="#9a9a9a")
        axes[2].set_xlabel("runs left out: -2 log L + 2 own,\nless the smallest")
        _limit_differences(axes[2], total - total.min())
    return turn_off_formulas(figure)


def _limit_differences(ax: Axes, values: FloatArray) -> None:
    """Let an axis of differences begin at 0, and be logarithmic where a hopeless model would hide the others."""
    if np.nanmax(values) > 100:
        ax.set_xscale("symlog", linthresh=10.0)
    ax.set_xlim(left=0.0)
