"""Text and figure of an experiment design: the input, the samples, and the standard errors to expect."""

from __future__ import annotations

import numpy as np

from switchfit.experiment_design.result import Design
from switchfit.problem.validation.messages import unit_suffix
from switchfit.report import panels, style
from switchfit.report import times as times_module
from switchfit.report.numbers import label_quantity
from switchfit.report.style import LINE, LINE_COLOURS, SMALL, THIN
from switchfit.report.tables import format_table, join_sections, wrap_text
from switchfit.runtime.presentation import Axes, Figure, draw_figure, format_text, join_first

MEANING = {"D": "log det", "A": "trace", "E": "largest eigenvalue"}
"""What of the covariance a criterion is."""

DRAWN_INPUT_TIMES = 1000
"""Times at which an input is drawn."""

_UNDETERMINED = (
    "This experiment cannot determine {}, whatever is measured: no sample depends on it, or only as on another "
    "unknown. Measure something else or at other times, let an input act, give a prior, or fix what is known."
)

_DOUBTFUL = (
    "The standard error of {} is larger than the distance to a bound or to the next transition, so that a fit is far "
    "from linear. Refits of simulated data, sf.monte_carlo(design.problem), say what will be known; a prior or another "
    "input may help."
)


@format_text.register(Design)
def write_design(design: Design) -> str:
    """Return standard errors and criterion before and after, what cannot be estimated, the input and the samples.

    Parameters
    ----------
    design : Design
    """
    path, units = design.trajectory, design.problem.unknowns.units
    # All unknowns, also those that do not count: their errors are what the design costs.
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
        listed = ", ".join(times_module.format_time(time, path) for time in times.tolist()) + times_module.suffix_time(
            path
        )
        texts.append(f"{sensor}: {len(times)} of {len(design.shares[sensor])} samples, at {listed}")
    return join_sections(wrap_text(head), format_table(rows, "<>>><", titles), *map(wrap_text, texts))


@draw_figure.register(Design)
def plot_design(design: Design) -> Figure:
    """Draw the input as given and as designed, the states, and the share of the information of each sample.

    Parameters
    ----------
    design : Design
    """
    path, units = design.trajectory, dict.fromkeys(design.trajectory.state_units)
    # A panel for the inputs, one for the states of each unit, and one for the shares of the samples.
    count = bool(design.inputs) + len(units) + 1
    figure = style.make_figure(8.0, 0.8 + 1.7 * count)
    axes = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0].tolist()
    if design.inputs:
        _draw_inputs(design, axes[0])
    # Those behind the inputs, if there are any, up to the last but one.
    for ax, unit in zip(axes[-len(units) - 1 :], units, strict=False):
        names = [name for name, own in zip(path.state_names, path.state_units, strict=True) if own == unit]
        for name, colour in style.assign_colours(names, LINE_COLOURS).items():
            ax.plot(path.times, path.states[:, path.state_names.index(name)], color=colour, linewidth=LINE, label=name)
        ax.set_ylabel(label_quantity(", ".join(names), unit))
    times = [item.times for item in design.given.experiments[design.experiment].data]
    colours = style.assign_colours(design.shares, LINE_COLOURS)
    for when, (name, shares) in zip(times, design.shares.items(), strict=True):
        # Filled where a sample is taken, empty where one might have been.
        taken = np.isin(when, design.sample_times.get(name, ()))
        axes[-1].vlines(when[taken], 0.0, shares[taken], color=colours[name], linewidth=LINE)
        axes[-1].plot(when[taken], shares[taken], "o", markersize=4, color=colours[name], label=name)
        axes[-1].plot(when[~taken], shares[~taken], "o", markersize=3, color=colours[name], fillstyle="none")
    axes[-1].set_ylabel("share of information")
    for ax in axes:
        panels.plot_modes(path, ax, labels=ax is axes[0])
        ax.label_outer()
        if len(ax.get_legend_handles_labels()[0]) > 1:
            ax.legend(loc="best", frameon=False, fontsize=SMALL)
    return style.turn_off_formulas(figure)


def _draw_inputs(design: Design, ax: Axes) -> None:
    """Draw each entry of the input, dashed as it was given."""
    for problem, line, width in ((design.given, "--", THIN), (design.problem, "-", LINE)):
        run = problem.experiments[design.experiment]
        times = np.linspace(design.trajectory.times[0], design.trajectory.times[-1], DRAWN_INPUT_TIMES)
        values = run.inputs.signal(run.t0, run.end)(times)
        colours = style.assign_colours(design.inputs, LINE_COLOURS)
        for (name, colour), curve in zip(colours.items(), values.T, strict=True):
            ax.plot(times, curve, line, color=colour, linewidth=width, label=name if line == "-" else None)
    ax.set_ylabel("input")
