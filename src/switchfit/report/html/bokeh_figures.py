"""Figures of a page, drawn with Bokeh.

Import this only where Bokeh is installed. The figures of runs are drawn without numbers, which the page's script puts
into the sources by their names. Colours that have to change with the reader's light or dark background carry the tag
"ink", "muted" or "edge"; the script sets them, and those of axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from bokeh import models
from bokeh.layouts import column
from bokeh.plotting import figure

from switchfit.report.html.curves import Columns, Curves
from switchfit.report.numbers import label_quantity
from switchfit.report.plane import find_plane
from switchfit.report.times import Timed, describe_clock, label_time

Plot: TypeAlias = Any
"""A figure of Bokeh. Bokeh's annotations know neither the tags of what is drawn, nor that an axis has the kinds
of label and ticker that it is given here."""

Renderer: TypeAlias = Any
"""What has drawn a curve into a `Plot`, which a tool for the pointer asks for."""

PAGE_FIT_COLOUR, PAGE_DATA_COLOUR = "#d0392b", "#5b6470"
"""Of what is fitted, readable on white and on black; of what is measured, until the page's script sets the ink."""

HEIGHT, RESIDUAL_HEIGHT, PATH_HEIGHT, SLICE_HEIGHT = 270, 130, 420, 230

PIXELS_LEFT_OF_AXES = 78
"""Pixels to the left of all axes, so that figures below one another share their times."""

UNBROKEN = {"break-inside": "avoid"}
"""A channel is printed on one page."""

WIDE: dict[str, Any] = {"sizing_mode": "stretch_width"}
TOOLS = "box_zoom,pan,wheel_zoom,reset,save"
UNDERLAY: dict[str, Any] = {"line_color": None, "level": "underlay"}
DOT_LOOK: dict[str, Any] = {"fill_color": PAGE_DATA_COLOUR, "fill_alpha": 0.75, "line_color": None, "tags": ["ink"]}

DASHED_LOOK: dict[str, Any] = {"line_color": PAGE_DATA_COLOUR, "line_dash": "dashed"}
"""Of shades below the curves, of what was measured, and of what it is compared with."""

DOT_SIZES = {150: 6.0, 600: 4.0, np.inf: 2.5}
"""Of up to so many samples."""

LABELS = {"measurements": "measured", "reference": "reference"}


def draw_run(curves: Sequence[Curves], columns: Mapping[str, Columns], *, run: Timed) -> models.Column:
    """Return the figures of one run below one another: each channel with its residuals, and the path in the plane.

    Parameters
    ----------
    curves : sequence of Curves
        Of one of the runs that share the drawing.
    columns : mapping of name to columns
        Of the same run, by the names of their sources.
    run : Timed
    """
    # A source by its name is how the page's script finds it: it puts numbers in, and moves them with the sliders.
    sources = {name: _make_source(name, own) for name, own in columns.items()}
    # One range for all panels of a run, so that they zoom together.
    times = models.Range1d(name="times")
    blocks: list[Any] = []
    for c, own in enumerate(curves):
        curve, samples = sources[f"curve-{c}"], sources.get(f"samples-{c}")
        for k, name in enumerate(own.names):
            panel = _make_time_figure(HEIGHT, times, label_quantity(name, own.units[k]), sources, run)
            line = _draw_curve(panel, own, k, curve)
            parts = [panel]
            if samples is not None:
                _draw_samples(panel, own, k, samples, run)
                below = _make_time_figure(RESIDUAL_HEIGHT, times, "residual", sources, run)
                below.yaxis.formatter = models.PrintfTickFormatter(format="%.2g")
                _draw_residuals(below, own, k, samples)
                # The labels of times are below the residuals.
                panel.xaxis.visible = False
                parts.append(below)
            parts[-1].xaxis.axis_label.text = label_time(run)
            _add_hover(panel, line, [("fitted", f"@y{k}{{%.6g}}"), ("mode", "@mode")], run)
            _put_legend_above(panel)
            blocks.append(column(*parts, name=f"channel-{c}-{k}", spacing=0, styles=UNBROKEN, **WIDE))
        if samples is not None and (plane := find_plane(own.names, own.units)) is not None:
            blocks.append(_draw_path(own, plane, curve, samples))
    return column(*blocks, spacing=6, **WIDE)


def _make_source(name: str, columns: Iterable[str]) -> models.ColumnDataSource:
    """Return a source with the columns, and those of the fit that the script keeps, but none of their numbers."""
    return models.ColumnDataSource({key: [] for own in columns for key in (own, f"fit_{own}")}, name=name)


def _make_figure(height: int, x: str, y: str, **settings: Any) -> Plot:
    """Return an empty figure with the labels of its axes."""
    frame: dict[str, Any] = {
        "sizing_mode": "stretch_width",
        "min_border_left": PIXELS_LEFT_OF_AXES,
        "min_border_right": 10,
    }
    plot = figure(height=height, tools=TOOLS, active_drag="box_zoom", toolbar_location="right", **frame, **settings)
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    plot.background_fill_color = plot.outline_line_color = None
    plot.xaxis.axis_label, plot.yaxis.axis_label = models.PlainText(text=x), models.PlainText(text=y)
    return plot


def _make_time_figure(
    height: int, times: models.Range1d, label: str, sources: Mapping[str, models.ColumnDataSource], run: Timed
) -> Plot:
    """Return a figure over time with the modes shaded, and the transition times in their intervals."""
    plot = _make_figure(height, "", label, x_range=times)
    plot.xgrid.visible = False
    plot.yaxis.ticker.desired_num_ticks = 5 if height > RESIDUAL_HEIGHT else 3
    clock = describe_clock(run)
    # Ticks at dates are found in the browser, by functions of the page's script: their text depends on the zoom.
    if clock is not None:
        find = "return switchfitDates.findTicks(cb_data.start, cb_data.end, start, length, zone)"
        label = "return switchfitDates.label(tick, ticks, start, length, zone)"
        plot.xaxis.ticker = models.CustomJSTicker(args=clock, major_code=find)
        plot.xaxis.formatter = models.CustomJSTickFormatter(args=clock, code=label)
    plot.vstrip(x0="left", x1="right", source=sources["modes"], fill_color="colour", fill_alpha=0.16, **UNDERLAY)
    own = sources["transitions"]
    plot.vstrip(x0="low", x1="high", source=own, fill_color=PAGE_DATA_COLOUR, fill_alpha=0.18, **UNDERLAY)
    line = plot.vspan(x="x", source=own, line_color=PAGE_DATA_COLOUR, line_width=1.3, tags=["ink"])
    if height > RESIDUAL_HEIGHT:
        tips = [("transition", "@name"), ("modes", "@modes"), ("time", "@value"), ("95 %", "@interval")]
        _add_hover(plot, line, tips)
    return plot


def _put_legend_above(plot: Plot) -> None:
    """Move the legend out of the way of the data; a click on an entry hides what it stands for."""
    plot.legend.click_policy = "hide"
    plot.legend.orientation = "horizontal"
    plot.add_layout(plot.legend[0], "above")


def _add_hover(plot: Plot, renderer: Renderer, tips: Sequence[tuple[str, str]], run: Timed | None = None) -> None:
    """Show (label, column) under the pointer, and the time of a run before them.

    Bokeh escapes what is in columns, but neither labels nor units.
    """
    formatters: dict[str, Any] = {text.partition("{")[0]: "printf" for _, text in tips if "%" in text}
    if run is not None:
        clock, unit = describe_clock(run), run.time_unit
        plain = unit if unit.isalnum() and unit != "1" else ""
        tips = [("time", f"@t{{%.6g}} {plain}".rstrip() if clock is None else "@t{custom}"), *tips]
        code = "return switchfitDates.show(value, 0.001, start, length, zone)"
        formatters["@t"] = "printf" if clock is None else models.CustomJSHover(args=clock, code=code)
    tool = models.HoverTool(renderers=[renderer], tooltips=list(tips), formatters=formatters, visible=False)
    plot.add_tools(tool)


def _draw_curve(plot: Plot, curves: Curves, k: int, source: models.ColumnDataSource) -> Renderer:
    """Draw what is fitted: its band, the fit itself that is shown once something has been moved; return what moves."""
    if "lo0" in curves.curve:
        band = {"y1": f"lo{k}", "y2": f"hi{k}", "legend_label": "95 % band"}
        plot.varea(x="fit_t", source=source, fill_color=PAGE_FIT_COLOUR, fill_alpha=0.25, **band)
    # Hidden until a slider moves: then the fit stays visible behind the curve that moves.
    still = {"name": "still", "visible": False, "tags": ["muted"]}
    plot.line("fit_t", f"fit_y{k}", source=source, line_width=1.2, **DASHED_LOOK, **still)
    return plot.line("t", f"y{k}", source=source, line_color=PAGE_FIT_COLOUR, line_width=2, legend_label="fitted")


def _draw_measured(
    plot: Plot, curves: Curves, x: str, y: str, source: models.ColumnDataSource, *, scale: float = 1.0, **legend: Any
) -> Renderer:
    """Draw what is measured as dots, or a reference signal as a dashed line."""
    if curves.kind == "reference":
        return plot.line(x, y, source=source, line_width=1.6, tags=["ink"], **DASHED_LOOK, **legend)
    size = next(size for most, size in DOT_SIZES.items() if len(curves.samples["t"]) <= most)
    return plot.scatter(x, y, source=source, size=scale * size, **DOT_LOOK, **legend)


def _draw_samples(plot: Plot, curves: Curves, k: int, source: models.ColumnDataSource, run: Timed) -> None:
    drawn = _draw_measured(plot, curves, "t", f"m{k}", source, legend_label=LABELS[curves.kind])
    if "o0" in curves.samples:
        label = "weighed down"
        plot.scatter(
            "t", f"o{k}", source=source, size=11, fill_color=None, line_color=PAGE_FIT_COLOUR, legend_label=label
        )
    tips = [(LABELS[curves.kind], f"@m{k}{{%.6g}}"), ("residual", f"@y{k}{{%.6g}}")]
    _add_hover(plot, drawn, tips, run)


def _draw_residuals(plot: Plot, curves: Curves, k: int, source: models.ColumnDataSource) -> None:
    plot.hspan(y=0.0, line_color=PAGE_FIT_COLOUR, line_width=1)
    for side in ("s", "n") if "s0" in curves.samples else ():
        plot.line("t", f"{side}{k}", source=source, line_color=PAGE_DATA_COLOUR, line_dash="dotted", tags=["muted"])
    _draw_measured(plot, curves, "t", f"y{k}", source, scale=0.75)


def _draw_path(
    curves: Curves, plane: tuple[int, int], curve: models.ColumnDataSource, samples: models.ColumnDataSource
) -> Plot:
    """Draw two positions against one another, with the transitions on the fitted path."""
    x, y = plane
    labels = [label_quantity(curves.names[k], curves.units[k]) for k in plane]
    plot = _make_figure(PATH_HEIGHT, *labels, match_aspect=True)
    _draw_measured(plot, curves, f"m{x}", f"m{y}", samples, legend_label=LABELS[curves.kind])
    plot.line(f"y{x}", f"y{y}", source=curve, line_color=PAGE_FIT_COLOUR, line_width=2, legend_label="fitted")
    mark: dict[str, Any] = {
        "marker": "diamond",
        "size": "size",
        "fill_color": PAGE_FIT_COLOUR,
        "line_color": PAGE_DATA_COLOUR,
        "tags": ["edge"],
    }
    plot.scatter(f"y{x}", f"y{y}", source=curve, legend_label="transition", **mark)
    _put_legend_above(plot)
    return plot


def draw_slice() -> Plot:
    """Return an empty figure of the rise of J along one unknown; the page's script fills it."""
    plot = _make_figure(SLICE_HEIGHT, "", "rise of J")
    plot.xaxis.axis_label.name = "slice-label"
    source, mark = _make_source("slice", ("x", "exact", "quadratic")), _make_source("mark", ("x", "y"))
    plot.line("x", "exact", source=source, line_color=PAGE_FIT_COLOUR, line_width=2, legend_label="exact")
    plot.line("x", "quadratic", source=source, legend_label="quadratic", tags=["muted"], **DASHED_LOOK)
    plot.scatter("x", "y", source=mark, size=10, fill_color=PAGE_FIT_COLOUR, line_color=PAGE_DATA_COLOUR, tags=["edge"])
    plot.yaxis.formatter = models.PrintfTickFormatter(format="%.2g")
    plot.xaxis.ticker.desired_num_ticks = 4  # labels of dates are long
    plot.xaxis.formatter = models.CustomJSTickFormatter(code="return switchfitSlice.label(tick, ticks)")
    _put_legend_above(plot)
    return plot
