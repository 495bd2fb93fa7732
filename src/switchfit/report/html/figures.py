"""Figures of a page, drawn with Bokeh. Import this only where Bokeh is installed.

Colours that have to change with the reader's light or dark background carry the tag "ink", "muted" or "faint"; the
page's script sets them. What a slider moves is found by name: sources "curve-K", "samples-K", "modes", "transitions".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special
from bokeh.layouts import column
from bokeh.models import CDSView, ColumnDataSource, FactorRange, HoverTool, IndexFilter, PlainText, Range1d, Span
from bokeh.plotting import figure

from switchfit.optimize import IterationRecord
from switchfit.problem.data import FloatArray
from switchfit.report.html.curves import Curves, find_plane
from switchfit.report.numbers import label_time
from switchfit.uncertainty.residuals import ChannelResiduals

FIT, DATA = "#d0392b", "#5b6470"
"""Of what is fitted, readable on white and on black; of what is measured, until the page's script sets the ink."""
HEIGHT, RESIDUAL_HEIGHT = 250, 130
LEFT = 78
"""Pixels to the left of all axes, so that figures below one another share their times."""
TOOLS = "box_zoom,pan,wheel_zoom,reset,save"
MOST_LABELLED = 12
"""Unknowns up to which the fields of the heat map have their numbers in them."""
HISTOGRAM_BINS = (6, 30)


@dataclass(frozen=True)
class Span1:
    """A stretch of time in which a mode is active.

    Attributes
    ----------
    mode, colour : str
    left, right : float
    left_place, right_place : int
        Places in theta of the times at its ends; -1 where they are known.
    """

    mode: str
    colour: str
    left: float
    right: float
    left_place: int
    right_place: int


@dataclass(frozen=True)
class Line:
    """A transition time.

    Attributes
    ----------
    name, value, interval, modes : str
        As the tables have them.
    time, low, high : float
        With the ends of its interval; NaN where it has none.
    place : int
        In theta; -1 where it is known.
    """

    name: str
    value: str
    interval: str
    modes: str
    time: float
    low: float
    high: float
    place: int


# --- a run ------------------------------------------------------------------------------------------------------------


def draw_run(
    curves: Sequence[Curves], spans: Sequence[Span1], lines: Sequence[Line], *, time_unit: str, shown: Sequence[bool]
) -> Any:
    """Return the figures of one run below one another: each channel with its residuals, and the path in the plane.

    Parameters
    ----------
    curves : sequence of Curves
    spans : sequence of Span1
    lines : sequence of Line
    time_unit : str
    shown : sequence of bool, one a channel of all curves
        Which are shown at first.
    """
    first, last = spans[0].left, spans[-1].right
    margin = 0.01 * (last - first)
    times = Range1d(first - margin, last + margin)
    modes, transitions = _make_span_source(spans), _make_line_source(lines)
    blocks: list[Any] = []
    number = 0
    for c, own in enumerate(curves):
        curve, samples = make_curve_source(own, c), make_sample_source(own, c)
        for k, name in enumerate(own.names):
            label = f"{name} ({own.units[k]})" if own.units[k] else name
            panel = _make_time_figure(HEIGHT, times, label)
            _draw_modes(panel, modes, transitions)
            _draw_curve(panel, own, k, curve)
            parts = [panel]
            if own.kind != "states":
                _draw_samples(panel, own, samples, f"m{k}", time_unit, k)
                below = _make_time_figure(RESIDUAL_HEIGHT, times, "residual")
                _draw_modes(below, modes, transitions)
                _draw_residuals(below, own, k, samples, time_unit)
                panel.xaxis.visible = False
                parts.append(below)
            parts[-1].xaxis.axis_label = PlainText(text=label_time(time_unit))
            _add_time_hover(panel, time_unit)
            panel.legend.location = "top_left"
            panel.legend.click_policy = "hide"
            panel.legend.orientation = "horizontal"
            blocks.append(
                column(*parts, name=f"channel-{number}", visible=shown[number], sizing_mode="stretch_width", spacing=0)
            )
            number += 1
        if (plane := find_plane(own)) is not None:
            blocks.append(_draw_path(own, plane, curve, samples))
    return column(*blocks, sizing_mode="stretch_width", spacing=6)


def make_curve_source(curves: Curves, c: int) -> ColumnDataSource:
    """Return what is fitted: t, mode, y0.., the same as b0.. that no slider moves, bands, tangents ``d{place}_{k}``.

    Parameters
    ----------
    curves : Curves
    c : int
        Its number in the run.
    """
    data: dict[str, Any] = {"t": curves.times, "bt": curves.times, "mode": curves.modes.tolist()}
    for k in range(len(curves.names)):
        data |= {f"y{k}": curves.values[:, k], f"b{k}": curves.values[:, k]}
        if curves.band is not None:
            data |= {f"lo{k}": curves.band[:, k, 0].astype("f4"), f"hi{k}": curves.band[:, k, 1].astype("f4")}
        data |= {f"d{place}_{k}": slope[:, k].astype("f4") for place, slope in curves.tangents.items()}
    tags = [{"channels": len(curves.names), "places": list(curves.tangents), "delay": curves.delay}]
    return ColumnDataSource(data, name=f"curve-{c}", tags=tags)


def make_sample_source(curves: Curves, c: int) -> ColumnDataSource:
    """Return what is measured: t, m0.., residuals y0.. and b0.., sigma s0.., tangents of the residuals.

    Parameters
    ----------
    curves : Curves
    c : int
        Its number in the run.
    """
    data: dict[str, Any] = {"t": curves.sample_times}
    residuals = curves.measured - curves.fitted
    for k in range(len(curves.names)):
        data |= {f"m{k}": curves.measured[:, k], f"y{k}": residuals[:, k], f"b{k}": residuals[:, k]}
        if curves.sigma is not None:
            data |= {f"s{k}": curves.sigma[:, k], f"n{k}": -curves.sigma[:, k]}
        data |= {f"d{place}_{k}": -slope[:, k].astype("f4") for place, slope in curves.sample_tangents.items()}
    tags = [{"channels": len(curves.names), "places": list(curves.sample_tangents), "delay": -1}]
    return ColumnDataSource(data, name=f"samples-{c}", tags=tags)


def _make_span_source(spans: Sequence[Span1]) -> ColumnDataSource:
    ends: dict[str, Any] = {
        "left": [s.left for s in spans],
        "right": [s.right for s in spans],
        "colour": [s.colour for s in spans],
        "left_place": [s.left_place for s in spans],
        "right_place": [s.right_place for s in spans],
    }
    return ColumnDataSource(ends | {"left_b": ends["left"], "right_b": ends["right"]}, name="modes")


def _make_line_source(lines: Sequence[Line]) -> ColumnDataSource:
    data: dict[str, Any] = {
        name: [getattr(line, name) for line in lines] for name in ("name", "value", "interval", "modes", "place")
    }
    times = np.array([line.time for line in lines], dtype=float)
    ends = {name: np.array([getattr(line, name) for line in lines], dtype=float) for name in ("low", "high")}
    return ColumnDataSource(data | ends | {"x": times, "x_b": times}, name="transitions")


def _make_figure(height: int, **settings: Any) -> Any:
    plot = figure(
        height=height,
        sizing_mode="stretch_width",
        tools=TOOLS,
        active_drag="box_zoom",
        toolbar_location="right",
        min_border_left=LEFT,
        min_border_right=10,
        **settings,
    )
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    plot.background_fill_color = plot.border_fill_color = None
    return plot


def _make_time_figure(height: int, times: Range1d, label: str) -> Any:
    plot = _make_figure(height, x_range=times)
    plot.yaxis.axis_label = PlainText(text=label)
    plot.xgrid.visible = False
    plot.yaxis.ticker.desired_num_ticks = 5 if height > RESIDUAL_HEIGHT else 3
    return plot


def _draw_modes(plot: Any, modes: ColumnDataSource, transitions: ColumnDataSource) -> None:
    """Shade the modes, and draw the transition times in their intervals."""
    plot.vstrip(
        x0="left", x1="right", source=modes, fill_color="colour", fill_alpha=0.16, line_color=None, level="underlay"
    )
    if transitions.data["x"].size:
        plot.vstrip(
            x0="low", x1="high", source=transitions, fill_color=DATA, fill_alpha=0.18, line_color=None, level="underlay"
        )
        line = plot.vspan(x="x", source=transitions, line_color=DATA, line_width=1.3, line_dash="solid")
        line.glyph.tags = ["ink"]
        tips = [("transition", "@name"), ("modes", "@modes"), ("time", "@value"), ("95 %", "@interval")]
        plot.add_tools(HoverTool(renderers=[line], tooltips=tips, visible=False))


def _draw_curve(plot: Any, curves: Curves, k: int, source: ColumnDataSource) -> None:
    if curves.band is not None:
        plot.varea(
            x="bt", y1=f"lo{k}", y2=f"hi{k}", source=source, fill_color=FIT, fill_alpha=0.25, legend_label="95 % band"
        )
    still = plot.line(x="bt", y=f"b{k}", source=source, line_color=DATA, line_dash="dashed", line_width=1.2)
    still.glyph.tags, still.name = ["muted"], "still"
    still.visible = False
    line = plot.line(x="t", y=f"y{k}", source=source, line_color=FIT, line_width=2, legend_label="fitted")
    line.name = "fitted"
    line.tags = [f"@y{k}"]


def _draw_samples(plot: Any, curves: Curves, source: ColumnDataSource, column_: str, time_unit: str, k: int) -> None:
    """Draw what is measured: dots, or a dashed line of a reference signal."""
    if curves.kind == "reference":
        drawn = plot.line(
            x="t",
            y=column_,
            source=source,
            line_color=DATA,
            line_dash="dashed",
            line_width=1.6,
            legend_label="reference",
        )
        drawn.glyph.tags = ["ink"]
        return
    size = 6.0 if len(curves.sample_times) <= 150 else 4.0 if len(curves.sample_times) <= 600 else 2.5
    drawn = plot.scatter(
        x="t",
        y=column_,
        source=source,
        size=size,
        fill_color=DATA,
        fill_alpha=0.75,
        line_color=None,
        legend_label="measured",
    )
    drawn.glyph.tags = ["ink"]
    if curves.outliers is not None and curves.outliers[:, k].any():
        view = CDSView(filter=IndexFilter(np.flatnonzero(curves.outliers[:, k]).tolist()))
        plot.scatter(
            x="t",
            y=column_,
            source=source,
            view=view,
            size=11,
            fill_color=None,
            line_color=FIT,
            legend_label="weighed down",
        )
    tips = [("time", _show("@t", time_unit)), ("measured", f"@{column_}{{%.6g}}"), ("residual", f"@y{k}{{%.3g}}")]
    formatters: dict[str, Any] = {"@t": "printf", f"@{column_}": "printf", f"@y{k}": "printf"}
    plot.add_tools(HoverTool(renderers=[drawn], tooltips=tips, formatters=formatters, visible=False))


def _draw_residuals(plot: Any, curves: Curves, k: int, source: ColumnDataSource, time_unit: str) -> None:
    zero = Span(location=0.0, dimension="width", line_color=FIT, line_width=1)
    plot.add_layout(zero)
    if curves.kind == "reference":
        drawn = plot.line(x="t", y=f"y{k}", source=source, line_color=DATA, line_width=1.2)
        drawn.glyph.tags = ["ink"]
    else:
        for side in ("s", "n") if curves.sigma is not None else ():
            edge = plot.line(x="t", y=f"{side}{k}", source=source, line_color=DATA, line_dash="dotted")
            edge.glyph.tags = ["muted"]
        size = 4.5 if len(curves.sample_times) <= 150 else 2.5
        drawn = plot.scatter(
            x="t", y=f"y{k}", source=source, size=size, fill_color=DATA, fill_alpha=0.75, line_color=None
        )
        drawn.glyph.tags = ["ink"]
    tips = [("time", _show("@t", time_unit)), ("residual", f"@y{k}{{%.3g}}")]
    formatters: dict[str, Any] = {"@t": "printf", f"@y{k}": "printf"}
    plot.add_tools(HoverTool(renderers=[drawn], tooltips=tips, formatters=formatters, visible=False))


def _add_time_hover(plot: Any, time_unit: str) -> None:
    """Show time, value and mode of the fitted curve under the pointer."""
    line = plot.select_one({"name": "fitted"})
    tips = [("time", _show("@t", time_unit)), ("fitted", f"{line.tags[0]}{{%.6g}}"), ("mode", "@mode")]
    formatters: dict[str, Any] = {"@t": "printf", line.tags[0]: "printf"}
    plot.add_tools(HoverTool(renderers=[line], tooltips=tips, formatters=formatters, line_policy="nearest"))


def _show(column_: str, unit: str) -> str:
    """Return the text of a number in a tooltip; a unit that Bokeh would read as a column or as HTML is left out."""
    plain = unit if unit.isalnum() and unit != "1" else ""
    return f"{column_}{{%.6g}} {plain}".rstrip()


def _draw_path(curves: Curves, plane: tuple[int, int], curve: ColumnDataSource, samples: ColumnDataSource) -> Any:
    """Draw two positions against one another, with the transitions on the fitted path."""
    x, y = plane
    plot = _make_figure(420, match_aspect=True)
    for axis, k in ((plot.xaxis, x), (plot.yaxis, y)):
        axis.axis_label = PlainText(
            text=f"{curves.names[k]} ({curves.units[k]})" if curves.units[k] else curves.names[k]
        )
    if curves.kind == "reference":
        drawn = plot.line(
            f"m{x}", f"m{y}", source=samples, line_color=DATA, line_dash="dashed", legend_label="reference"
        )
    else:
        drawn = plot.scatter(
            f"m{x}",
            f"m{y}",
            source=samples,
            size=6,
            fill_color=DATA,
            fill_alpha=0.75,
            line_color=None,
            legend_label="measured",
        )
    drawn.glyph.tags = ["ink"]
    line = plot.line(f"y{x}", f"y{y}", source=curve, line_color=FIT, line_width=2, legend_label="fitted")
    breaks = np.flatnonzero(np.isnan(curves.times))
    if len(breaks):
        view = CDSView(filter=IndexFilter((breaks + 1).tolist()))
        mark = plot.scatter(
            f"y{x}",
            f"y{y}",
            source=curve,
            view=view,
            marker="diamond",
            size=13,
            fill_color=FIT,
            line_color=DATA,
            legend_label="transition",
        )
        mark.glyph.tags = ["edge"]
    tips = [("time", "@t{%.6g}"), ("mode", "@mode")]
    plot.add_tools(HoverTool(renderers=[line], tooltips=tips, formatters={"@t": "printf"}))
    plot.legend.click_policy = "hide"
    plot.name = "path"
    return plot


# --- residuals --------------------------------------------------------------------------------------------------------


def draw_diagnostics(channel: ChannelResiduals) -> list[Any]:
    """Return the histogram, the quantiles and the autocorrelation of one channel's standardised residuals.

    Parameters
    ----------
    channel : ChannelResiduals
    """
    return [_draw_histogram(channel), _draw_quantiles(channel), _draw_autocorrelation(channel)]


def _make_small(x: str, y: str) -> Any:
    plot = _make_figure(230)
    plot.min_border_left = 55
    plot.xaxis.axis_label, plot.yaxis.axis_label = PlainText(text=x), PlainText(text=y)
    return plot


def _draw_histogram(channel: ChannelResiduals) -> Any:
    unit = "residual / sigma" if channel.sigma_known else "residual / rms"
    plot = _make_small(unit, "density")
    few, many = HISTOGRAM_BINS
    bins = int(np.clip(np.sqrt(len(channel.values)), few, many))
    density, edges = np.histogram(channel.values, bins=bins, density=True)
    bars = plot.quad(
        left=edges[:-1], right=edges[1:], bottom=0, top=density, fill_color=DATA, fill_alpha=0.35, line_color=None
    )
    bars.glyph.tags = ["ink"]
    grid = np.linspace(min(edges[0], -3.5), max(edges[-1], 3.5), 121)
    plot.line(grid, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), line_color=FIT, line_width=1.6)
    plot.y_range.start = 0
    return plot


def _draw_quantiles(channel: ChannelResiduals) -> Any:
    plot = _make_small("normal quantile", "residual")
    n = len(channel.values)
    expected = scipy.special.ndtri((np.arange(1, n + 1) - 0.5) / n)
    plot.line(expected[[0, -1]], expected[[0, -1]], line_color=FIT, line_width=1.4)
    kept = np.unique(np.linspace(0, n - 1, min(n, 500)).astype(int))
    dots = plot.scatter(expected[kept], np.sort(channel.values)[kept], size=4, fill_color=DATA, line_color=None)
    dots.glyph.tags = ["ink"]
    return plot


def _draw_autocorrelation(channel: ChannelResiduals) -> Any:
    plot = _make_small("lag (samples)", "autocorrelation")
    limit = 1.96 / np.sqrt(max(len(channel.values), 1))
    plot.hstrip(y0=[-limit], y1=[limit], fill_color="#4a7fb5", fill_alpha=0.2, line_color=None, level="underlay")
    lags = np.arange(1, channel.lags + 1)
    plot.segment(lags, np.zeros(len(lags)), lags, channel.autocorrelation, line_color=FIT, line_width=2)
    plot.scatter(lags, channel.autocorrelation, size=6, fill_color=FIT, line_color=None)
    reach = min(max(1.3 * float(np.max(np.abs(channel.autocorrelation), initial=0.0)), 2 * limit), 1.05)
    plot.y_range = Range1d(-reach, reach)
    plot.xaxis.ticker.min_interval = 1
    zero = Span(location=0.0, dimension="width", line_color=DATA, line_width=1, tags=["ink"])
    plot.add_layout(zero)
    return plot


# --- the whole fit ----------------------------------------------------------------------------------------------------


def draw_convergence(history: Sequence[IterationRecord], tolerance: float) -> list[Any]:
    """Return J and the optimality by iteration.

    Parameters
    ----------
    history : sequence of IterationRecord
    tolerance : float
    """
    iterations = [record.iteration for record in history]
    costs = np.array([record.cost for record in history], dtype=float)
    wide = costs.min(initial=np.inf) > 0 and costs.max(initial=0.0) > 30 * costs.min(initial=np.inf)
    found = []
    optimality = np.array([record.optimality for record in history], dtype=float)
    optimality = np.where(optimality > 0, optimality, np.nan)
    given = ((costs, "cost J", "log" if wide else "linear"), (optimality, "optimality (KKT residual)", "log"))
    for values, label, scale in given:
        plot = _make_figure(240, y_axis_type=scale)
        plot.xaxis.axis_label, plot.yaxis.axis_label = PlainText(text="iteration"), PlainText(text=label)
        source = ColumnDataSource({"x": iterations, "y": values, "step": [record.step for record in history]})
        plot.line("x", "y", source=source, line_color=FIT, line_width=1.6)
        dots = plot.scatter("x", "y", source=source, size=6, fill_color=FIT, line_color=None)
        tips = [("iteration", "@x"), ("value", "@y{%.8g}"), ("step", "@step{%.3g}")]
        formatters: dict[str, Any] = {"@y": "printf", "@step": "printf"}
        plot.add_tools(HoverTool(renderers=[dots], tooltips=tips, formatters=formatters))
        plot.xaxis.ticker.min_interval = 1
        if values is optimality:
            plot.add_layout(
                Span(location=tolerance, dimension="width", line_color=DATA, line_dash="dashed", tags=["muted"])
            )
        found.append(plot)
    return found


def draw_correlation(names: Sequence[str], correlation: FloatArray) -> Any:
    """Return the heat map of the correlations; red is positive, blue negative, the stronger the more opaque.

    Parameters
    ----------
    names : sequence of str
    correlation : (d, d)
        NaN for unknowns that are held.
    """
    d = len(names)
    rows, columns = (grid.ravel() for grid in np.indices((d, d)))
    known = np.isfinite(correlation[rows, columns])
    rows, columns = rows[known], columns[known]
    values = correlation[rows, columns]
    data = {
        "x": [names[i] for i in columns],
        "y": [names[i] for i in rows],
        "value": values,
        "colour": np.where(values > 0, "#d0392b", "#2f74c0").tolist(),
        "alpha": np.abs(values),
        "text": [f"{value:.2f}" for value in values],
    }
    source = ColumnDataSource(data)
    side = min(max(220 + 24 * d, 300), 900)
    plot = _make_figure(side, x_range=FactorRange(*names), y_range=FactorRange(*reversed(names)))
    plot.max_width = side + 120
    plot.min_border_left = 20
    drawn = plot.rect(
        "x", "y", 1, 1, source=source, fill_color="colour", fill_alpha="alpha", line_color=DATA, line_alpha=0.25
    )
    if d <= MOST_LABELLED:
        text = plot.text(
            "x", "y", text="text", source=source, text_align="center", text_baseline="middle", text_font_size="11px"
        )
        text.glyph.tags = ["ink"]
    plot.add_tools(
        HoverTool(
            renderers=[drawn],
            tooltips=[("unknowns", "@x, @y"), ("correlation", "@value{%.3f}")],
            formatters={"@value": "printf"},
        )
    )
    plot.xaxis.major_label_orientation = 0.9
    plot.grid.visible = False
    return plot


def draw_slice() -> Any:
    """Return an empty figure of J along one unknown; the page's script fills the sources "slice" and "mark"."""
    plot = _make_figure(230)
    plot.min_border_left = 70
    plot.xaxis.axis_label, plot.yaxis.axis_label = PlainText(text="", name="slice-label"), PlainText(text="cost J")
    none: Mapping[str, Any] = {"x": [], "exact": [], "quadratic": []}
    source = ColumnDataSource(dict(none), name="slice")
    plot.line("x", "exact", source=source, line_color=FIT, line_width=2, legend_label="exact")
    quadratic = plot.line(
        "x", "quadratic", source=source, line_color=DATA, line_dash="dashed", legend_label="quadratic"
    )
    quadratic.glyph.tags = ["muted"]
    mark = plot.scatter(
        "x", "y", source=ColumnDataSource({"x": [], "y": []}, name="mark"), size=10, fill_color=FIT, line_color=DATA
    )
    mark.glyph.tags = ["edge"]
    plot.legend.click_policy = "hide"
    plot.legend.location = "top_center"
    return plot
