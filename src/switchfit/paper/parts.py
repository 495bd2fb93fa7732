"""The parts of the paper's Section V: for each, what computes, draws and tabulates it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from switchfit.paper import convergence, magic_reference, noise, oscillator, starts, trials, vehicle_figure
from switchfit.paper.table_rows import Found, Say, TableRow
from switchfit.runtime.presentation import Figure


class Part(NamedTuple):
    """One part of the paper.

    Attributes
    ----------
    title : str
    compute : callable ``(quick, say)``
        Returns results as plain numbers and lists.
    draw : callable
        Returns figures drawn from these results alone, by the names of their files.
    list_rows : callable
        Returns the lines of the table, from these results.
    """

    title: str
    compute: Callable[[bool, Say], Found]
    draw: Callable[[Found], dict[str, Figure]] = lambda found: {}
    list_rows: Callable[[Found], list[TableRow]] = lambda found: []


#: Name -> part, in the order of the paper.
PARTS: Mapping[str, Part] = {
    "vehicle": Part("The vehicle (Fig. 2)", vehicle_figure.compute_vehicle, vehicle_figure.draw_vehicle),
    "lti": Part("Linear time-invariant example", oscillator.compute_lti, oscillator.draw_lti, oscillator.list_lti),
    "magic-formula": Part(
        "Magic Formula reference (Fig. 3)",
        magic_reference.compute_magic,
        magic_reference.draw_magic,
        magic_reference.list_magic,
    ),
    "convergence": Part(
        "Convergence (Fig. 4)",
        convergence.compute_convergence,
        convergence.draw_convergence,
        convergence.list_convergence,
    ),
    "noise": Part("Measurement noise (Fig. 5)", noise.compute_noise, noise.draw_noise, noise.list_noise),
    "trials": Part("Trials (Fig. 6)", trials.compute_trials, trials.draw_trials, trials.list_trials),
    "starts": Part("Starts", starts.compute_starts, list_rows=starts.list_starts),
}
