"""Whether the parts of a problem fit one another: modes, parameters, maps, noise, delays and initial states."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from switchfit.problem.experiment import Experiment, initial_state_of, name_runs
from switchfit.problem.parameter import Parameter, as_parameter, unit_suffix
from switchfit.problem.system import HybridSystem
from switchfit.problem.unknowns import require_one_time_unit
from switchfit.problem.validation import as_name, as_number, join_names, shorten


def check_parameters(parameters: Any) -> dict[str, Parameter]:
    """Return the parameters of a problem by their names."""
    if not isinstance(parameters, Mapping | None):
        raise TypeError(f"parameters must be a dict of name -> value or sf.Parameter; got {shorten(parameters)}.")
    given = {} if parameters is None else parameters
    names = [as_name(name, "parameter names", "strings") for name in given]
    return {name: as_parameter(given[name], f"parameter {shorten(name)}") for name in names}


def check_durations(given: Any, system: HybridSystem) -> float | dict[str, float]:
    """Return the shortest duration of all modes, or of each mode that a mapping names."""
    if not isinstance(given, Mapping):
        return as_number(given, "min_duration")
    for mode in given:
        if mode not in system.modes:
            raise ValueError(
                f"min_duration names the unknown mode {shorten(mode)}; the modes are {join_names(system.modes)}."
            )
    return {mode: as_number(value, f"min_duration of {shorten(mode)}") for mode, value in given.items()}


def check_sequences(system: HybridSystem, experiments: tuple[Experiment, ...], max_transitions: int | None) -> None:
    """Check the names of modes in mode sequences, and the number of transitions against `max_transitions`."""
    for experiment in experiments:
        for mode in experiment.mode_sequence:
            if mode not in system.modes:
                raise ValueError(
                    f"mode_sequence names the unknown mode {shorten(mode)}; the modes are {join_names(system.modes)}."
                )
    if max_transitions is not None:
        longest = max(len(e.transition_times) + len(e.jump_times) for e in experiments)
        if max_transitions < longest:
            jumps = " and jumps" if any(len(e.jump_times) for e in experiments) else ""
            raise ValueError(
                f"max_transitions is {max_transitions}, but a mode_sequence has {longest} transitions{jumps}."
            )


def check_maps(experiments: tuple[Experiment, ...], parameters: Mapping[str, Parameter]) -> None:
    """Check that parameter maps lead to parameters."""
    for name, experiment in zip(name_runs(experiments), experiments, strict=True):
        for here, target in experiment.parameter_map.items():
            if target not in parameters:
                raise ValueError(
                    f"parameter_map of experiment {join_names([name])} gives the model's {shorten(here)} as the "
                    f"unknown parameter {shorten(target)}; the problem has {join_names(parameters)}."
                )


def check_states(system: HybridSystem, experiments: tuple[Experiment, ...]) -> None:
    """Check the sizes of initial states that are not functions."""
    own = system.initial_state
    for e, experiment in enumerate(experiments):
        initial = initial_state_of(system, experiment)
        if callable(initial):
            continue
        if not callable(own) and len(initial) != len(own):
            raise ValueError(
                f"initial_state of experiment {experiment.name or e + 1} must have "
                f"{len(own)} entries, as the system's has; got {len(initial)}."
            )
        system.check_labels_of(len(initial))


def check_noise(experiments: tuple[Experiment, ...], parameters: Mapping[str, Parameter], *, has_priors: bool) -> None:
    """Check the parameters that are a sigma, and that the noise is known where something is weighed against it."""
    items = [(e, item) for e in experiments for item in e.measurements]
    for experiment, item in items:
        for name in filter(None, item.sigma_names):
            parameter = parameters.get(experiment.parameter_map.get(name, name))
            if parameter is None:
                raise ValueError(
                    f"sigma names the parameter {shorten(name)}, which the problem lacks; it has "
                    f"{join_names(parameters)}."
                )
            if parameter.shape != () or not (parameter.positive or (parameter.fixed and parameter.value > 0)):
                raise ValueError(
                    f"sigma names the parameter {name!r}, which must be one number that stays positive: give it a "
                    f"lower bound above 0, or scale='log'; got shape {parameter.shape}, lower bound "
                    f"{parameter.lower.tolist()}."
                )
    unknown = any(item.sigma is None for _, item in items)
    if unknown and any(item.sigma_names or item.loss != "linear" for _, item in items):
        raise ValueError(
            "sigma is left out in some Measurements, and a parameter or measured against by a robust loss in "
            "others: their costs are then not in the same units. Name a parameter for it there too."
        )
    if unknown and has_priors:
        raise ValueError(
            "a prior is weighed against the noise of the Measurements, whose sigma is left out: give sigma a "
            "number, or the name of a parameter to estimate it."
        )


def check_delays(experiments: tuple[Experiment, ...], parameters: Mapping[str, Parameter]) -> None:
    """Check the parameters that are a delay: within their bounds all samples must be of times inside
    the horizon.
    """
    for experiment in experiments:
        for item in experiment.measurements:
            if not isinstance(item.delay, str):
                continue
            parameter = parameters.get(experiment.parameter_map.get(item.delay, item.delay))
            if parameter is None or parameter.shape != ():
                raise ValueError(
                    f"delay names {shorten(item.delay)}, which must be a parameter of one number; the problem has "
                    f"{join_names(parameters)}."
                )
            _check_delay_unit(experiments, parameters, experiment, item.delay)
            unit = unit_suffix(experiment.time_unit)
            low, high = item.times[-1] - experiment.earliest_end, item.times[0] - experiment.t0
            least, most = (parameter.value,) * 2 if parameter.fixed else (parameter.lower, parameter.upper)
            if not low <= least <= most <= high:
                raise ValueError(
                    f"the delay {item.delay!r} may lie in [{least}, {most}]{unit} (its bounds, if it is not "
                    f"fixed), but only from {low:.6g} to {high:.6g}{unit} are all samples of moments inside "
                    f"(t0, tf) = ({experiment.t0}, {experiment.earliest_end}): give it narrower bounds, move t0 "
                    "or tf, or leave out samples at the ends."
                )


def _check_delay_unit(
    experiments: tuple[Experiment, ...], parameters: Mapping[str, Parameter], experiment: Experiment, delay: str
) -> None:
    """Check that a delay is in the unit of its experiment, and shared only by experiments of one time unit."""
    name = experiment.parameter_map.get(delay, delay)
    unit = parameters[name].unit
    if unit not in ("", experiment.time_unit):
        raise ValueError(
            f"the delay {name!r} has the unit {unit!r}, but time_unit of its experiment is "
            f"{experiment.time_unit!r}, and times are not converted. Give both in the same unit."
        )
    runs = zip(name_runs(experiments), experiments, strict=True)
    units = {run: e.time_unit for run, e in runs if name in _find_delay_targets(e)}
    require_one_time_unit(units, f"the delay {name!r}", "give each run a delay of its own (parameter_map)")


def _find_delay_targets(experiment: Experiment) -> set[str]:
    """Return names of the problem's parameters that are delays in an experiment."""
    delays = (item.delay for item in experiment.measurements)
    return {experiment.parameter_map.get(delay, delay) for delay in delays if isinstance(delay, str)}
