"""The figure of a forecast: each output with its bands, what was measured, and where the data end."""

from __future__ import annotations

import numpy as np

from switchfit.fit.comparison import find_delay
from switchfit.report import panels, style
from switchfit.report.numbers import wrap_quantity
from switchfit.report.style import FIT_COLOUR, LINE, THIN, TRANSITION_COLOUR
from switchfit.runtime.presentation import Figure, draw_figure
from switchfit.uncertainty.prediction import Prediction


@draw_figure.register(Prediction)
def plot_prediction(prediction: Prediction, *, level: float = 0.95) -> Figure:
    """Draw each output over time with its bands, what was measured, the modes, and where the data end.

    Parameters
    ----------
    prediction : Prediction
    level : float, between 0 and 1
    """
    outputs = panels.list_outputs(prediction.fit, prediction.experiment)
    trajectory, order = prediction.fit.trajectories[prediction.experiment], np.argsort(prediction.times, kind="stable")
    times, values = prediction.times[order], prediction.outputs if prediction.output_names else prediction.states
    begin, end = trajectory.mode_spans[0][1], trajectory.mode_spans[-1][2]
    figure = style.make_figure(8.0, 0.9 + 2.6 * len(outputs))
    axes = figure.subplots(len(outputs), 1, sharex=True, squeeze=False)[:, 0]
    for number, ((comparison, k), ax) in enumerate(zip(outputs, axes, strict=True)):
        panels.plot_bands(prediction, number, level, ax)
        late = find_delay(comparison, trajectory)
        ax.plot(times + late, values[order, number], "-", color=FIT_COLOUR, linewidth=LINE, zorder=4, label="predicted")
        panels.draw_measured(comparison, comparison.times, comparison.measured[:, k], ax)
        panels.plot_modes(trajectory, ax, labels=ax is axes[0])
        # The forecast goes on in the last mode, whose colour is drawn on up to its end.
        if times[-1] > end:
            colour = panels.choose_mode_colours([trajectory])[trajectory.mode_spans[-1][0]]
            ax.axvspan(end, times[-1], color=colour, linewidth=0, zorder=0)
            ax.axvline(end, color=TRANSITION_COLOUR, linestyle="--", linewidth=THIN, zorder=2, label="end of the data")
        style.label_axis(ax, prediction)
        ax.set_xlim(min(times[0], begin), max(times[-1], end))
        ax.set_ylabel(wrap_quantity(comparison.names[k], comparison.units[k]))
        ax.label_outer()
    figure.draw_legend(style.collect_handles(axes), loc="outside upper right")
    return style.turn_off_formulas(figure)
