"""Checks of a problem's arguments against one another: parameters, durations, and names in experiments."""

from __future__ import annotations

from collections.abc import Mapping

from switchfit.problem.experiment import Experiment
from switchfit.problem.parameter import Parameter, as_parameter, require_time_unit
from switchfit.problem.system import HybridSystem
from switchfit.problem.validation.arrays import as_not_negative
from switchfit.problem.validation.messages import join_names, shorten, unit_suffix
from switchfit.problem.validation.names import as_name, require_known


def check_parameters(parameters: object) -> dict[str, Parameter]:
    """Return the parameters of a problem by their names."""
    if not isinstance(parameters, Mapping | None):
        raise TypeError(f"parameters must be a dict of name -> value or sf.Parameter; got {shorten(parameters)}.")
    return {
        as_name(name, "parameter names", "strings"): as_parameter(value, f"parameter {shorten(name)}")
        for name, value in (parameters or {}).items()
    }


def check_durations(given: object, system: HybridSystem) -> float | dict[str, float]:
    """Return the shortest duration of all modes, or of each mode that a mapping names."""
    if not isinstance(given, Mapping):
        return as_not_negative(given, "min_duration")
    require_known(given, "min_duration", system.modes)
    return {mode: as_not_negative(value, f"min_duration of {shorten(mode)}") for mode, value in given.items()}


def check_names(run: Experiment, parameters: Mapping[str, Parameter]) -> None:
    """Check the parameters that a map, a sigma or a delay names; with a delay, all samples must be inside the horizon
    wherever it is within its bounds.
    """
    for here, target in run.parameter_map.items():
        if target not in parameters:
            raise ValueError(
                f"parameter_map has {shorten(here)} -> {shorten(target)}, but the problem has {join_names(parameters)}."
            )

    def find_scalar(what: str, name: str) -> Parameter:
        parameter = parameters.get(run.parameter_map.get(name, name))
        if parameter is None or parameter.shape != ():
            raise ValueError(
                f"{what} names {shorten(name)}, which must be a parameter of one number; the problem has "
                f"{join_names(parameters)}."
            )
        return parameter

    for item in run.measurements:
        for name in filter(None, item.sigma_names):
            sigma = find_scalar("sigma", name)
            # At sigma = 0 the likelihood is infinite wherever a residual is 0, and the optimizer goes there.
            if not (sigma.positive or (sigma.fixed and sigma.value > 0)):
                raise ValueError(
                    f"sigma names the parameter {name!r}, which must stay positive: give it a lower bound above 0, or "
                    f"scale='log'; got the lower bound {sigma.lower}."
                )
        if isinstance(item.delay, str):
            delay = find_scalar("delay", item.delay)
            require_time_unit(delay, f"the delay {item.delay!r}", run.time_unit)
            # With a delay d, samples are of the state at t - d: all of t - d inside the horizon is a condition on the
            # bounds of d.
            low, high = item.times[-1] - run.earliest_end, item.times[0] - run.t0
            least, most = (delay.value,) * 2 if delay.fixed else (delay.lower, delay.upper)
            if not low <= least <= most <= high:
                raise ValueError(
                    f"the delay {item.delay!r} may lie in [{least}, {most}], but only from {low:.6g} to {high:.6g}"
                    f"{unit_suffix(run.time_unit)} are all samples inside (t0, tf) = ({run.t0}, {run.earliest_end}): "
                    "give it narrower bounds, move t0 or tf, or leave out samples at the ends."
                )
