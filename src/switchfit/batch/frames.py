"""The numbers of many fits as a table for pandas: a row for each fit."""

from __future__ import annotations

import numpy as np

from switchfit.batch.bootstrap_study import Bootstrap
from switchfit.batch.fits import Fits
from switchfit.batch.starts import Multistart
from switchfit.report.frames import ERROR, HIGH, LOW, split_columns
from switchfit.runtime.frames import Column, Frame, describe_frame


@describe_frame.register(Fits)
def describe_fits(fits: Fits) -> Frame:
    """Return a row for each fit.

    Parameters
    ----------
    fits : Fits
    """
    low, high = np.moveaxis(fits.confidence_intervals(), -1, 0)
    errors = np.where(fits.standard_errors > 0, fits.standard_errors, np.nan)
    columns = [Column("level", fits.levels), Column("status", fits.status)]
    if isinstance(fits, Multistart):
        columns.append(Column("cluster", fits.clusters))
    own = {"{}": fits.theta, ERROR: errors, LOW: low, HIGH: high, "{} start": fits.start}
    for label, values in own.items():
        columns += split_columns(values, fits.theta_names, fits.theta_units, label)
    names = ("cost", "explained", "samples", "optimality", "iterations", "evaluations", "collapsed", "at_bounds")
    columns += [Column(name, getattr(fits, name)) for name in (*names, "message")]
    # What is true of the study as a whole; `requested` is more than the rows where it was stopped.
    attributes: dict[str, str | float] = {"requested": fits.requested, "seconds": float(fits.seconds)}
    if isinstance(fits, Bootstrap):
        attributes["resample"] = fits.resample
    return Frame((Column("run", fits.runs),), tuple(columns), attributes)
