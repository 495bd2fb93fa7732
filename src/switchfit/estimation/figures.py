"""Figures of an estimate as its methods; `switchfit.report` draws them."""

from __future__ import annotations

from typing import overload

from switchfit.fit.result import Fit
from switchfit.runtime.presentation import Axes, Figure, draw_figure
from switchfit.uncertainty.residuals import ResidualDiagnostics, diagnose


class FitFigures(Fit):
    """A fit whose methods draw it."""

    def plot(self, *, bands: bool = True, level: float = 0.95) -> Figure:
        """Draw measured against fitted over time with the modes shaded, as a matplotlib Figure.

        Parameters
        ----------
        bands : bool
            Whether to draw confidence and prediction bands of the fitted values, which need the model and a covariance.
            The first ones of a model take a second to compile.
        level : float, between 0 and 1
            Level of the bands.

        See Also
        --------
        Estimate.plot_residuals, Estimate.predict

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fit = sf.estimate(heater_problem())

        >>> figure = fit.plot(bands=False)
        >>> len(figure.axes)
        2
        """
        return draw_figure(self, bands=bands, level=level)

    @property
    def residuals(self) -> ResidualDiagnostics:
        """Tests of the residuals, channel by channel: whiteness, normality, effective sample size."""
        return diagnose(self)

    def plot_residuals(self) -> Figure:
        """Draw residuals in time, their autocorrelation and their quantiles, as a matplotlib Figure.

        See Also
        --------
        Estimate.residuals, Estimate.plot

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fit = sf.estimate(heater_problem())

        >>> len(fit.plot_residuals().axes)
        3
        """
        return draw_figure(self.residuals)

    @overload
    def plot_convergence(self, *, ax: None = ...) -> Figure: ...
    @overload
    def plot_convergence(self, *, ax: Axes) -> Axes: ...
    def plot_convergence(self, *, ax: Axes | None = None) -> Axes | Figure:
        """Draw the optimality against iteration on a logarithmic scale, with the tolerance.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, which are returned; without them, a Figure is made and returned.

        See Also
        --------
        Estimate.plot, Estimate.profile

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fit = sf.estimate(heater_problem())

        >>> fit.plot_convergence().axes[0].get_xlabel()
        'iteration'
        """
        return draw_figure(self, what="convergence", ax=ax)

    @overload
    def plot_timeline(self, *, level: float = ..., ax: None = ...) -> Figure: ...
    @overload
    def plot_timeline(self, *, level: float = ..., ax: Axes) -> Axes: ...
    def plot_timeline(self, *, level: float = 0.95, ax: Axes | None = None) -> Axes | Figure:
        """Draw which mode is active when, a row for each experiment, with intervals of the transition times.

        Parameters
        ----------
        level : float, between 0 and 1
            Of the intervals.
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, which are returned; without them, a Figure is made and returned.

        See Also
        --------
        Estimate.plot, Estimate.profile

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fit = sf.estimate(heater_problem())

        >>> [text.get_text() for text in fit.plot_timeline().axes[0].texts]
        ['on', 'off']
        """
        return draw_figure(self, what="timeline", level=level, ax=ax)

    @overload
    def plot_plane(
        self, *, channels: tuple[str, str] | None = ..., experiment: int = ..., ax: None = ...
    ) -> Figure: ...
    @overload
    def plot_plane(self, *, channels: tuple[str, str] | None = ..., experiment: int = ..., ax: Axes) -> Axes: ...
    def plot_plane(
        self,
        *,
        channels: tuple[str, str] | None = None,
        experiment: int = 0,
        ax: Axes | None = None,
    ) -> Axes | Figure:
        """Draw the path in the plane where two positions are measured.

        Parameters
        ----------
        channels : (str, str), optional
            Names of the two positions; left out, they are told by names such as X and Y or east and north.
        experiment : int
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, which are returned; without them, a Figure is made and returned.

        Raises
        ------
        ValueError
            If no two channels are positions in a plane, or those that are named do not exist.

        See Also
        --------
        Estimate.plot, Estimate.profile

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fit = sf.estimate(heater_problem())

        >>> try:  # a drive with two positions has such a figure, a room with one thermometer has none
        ...     fit.plot_plane()
        ... except ValueError as error:
        ...     print(str(error).partition(";")[0])
        no two channels of the same data are positions in a plane by their names
        """
        return draw_figure(self, what="plane", channels=channels, experiment=experiment, ax=ax)
