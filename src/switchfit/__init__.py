"""switchfit: when did the system switch mode, and what were its parameters?

A public name is imported from its module when it is first used: ``import switchfit`` alone imports neither JAX nor
NumPy, so that the command line answers ``--help`` at once. Type checkers read the same names in ``__init__.pyi``.
"""

from importlib import import_module as _import_module

from switchfit.runtime import load_later as _load_later
from switchfit.runtime.xla_flags import compile_small_loops_whole as _compile_small_loops_whole

_compile_small_loops_whole()  # now: XLA reads its flags when it first compiles, in whatever part of the program
_REGISTERING = (
    "report", "estimation.comparison_report", "batch.figures", "batch.frames", "batch.tables", "modes.ending_report",
    "modes.rates_report", "modes.search_figure", "modes.search_report", "online.report", "experiment_design.report",
)  # fmt: skip
"""Modules that register how results are printed and drawn."""

_load_later(lambda: [_import_module(f"switchfit.{name}") for name in _REGISTERING])

__version__ = "0.1.0"

_MODULES = {
    "ActiveConstraint": "problem.constraints",
    "Alarm": "online.state",
    "Bootstrap": "batch.bootstrap_study",
    "Calibration": "online.calibration",
    "Certificate": "uncertainty.certificate",
    "ChannelResiduals": "uncertainty.residuals",
    "Comparison": "fit.comparison",
    "Design": "experiment_design.result",
    "DerivativeCheck": "uncertainty.derivative_check",
    "Direction": "uncertainty.identification",
    "Estimate": "estimation.estimates",
    "Evaluation": "engine.evaluation",
    "Experiment": "problem.experiment",
    "Fits": "batch.fits",
    "GuardedEvaluation": "fit.guards",
    "HybridSystem": "problem.system",
    "Identifiability": "uncertainty.identification",
    "Input": "problem.inputs",
    "InputCorrelation": "strategy.input_correlation",
    "Insertion": "modes.rates",
    "Issue": "runtime.issue",
    "Jump": "problem.jump",
    "Kink": "fit.termination",
    "Log": "io.logs.log",
    "LogNormal": "problem.priors",
    "Measurements": "problem.measurements",
    "ModeEnding": "modes.status",
    "ModeFit": "modes.result",
    "ModeSearch": "modes.result",
    "ModeStatus": "modes.status",
    "ModeWarning": "modes.status",
    "ModelComparison": "estimation.comparison",
    "MonteCarlo": "batch.monte_carlo_study",
    "Multistart": "batch.starts",
    "Normal": "problem.priors",
    "Now": "online.state",
    "OnlineEstimator": "online.estimator",
    "OnlineLog": "online.log",
    "OnlineStatus": "online.state",
    "Parameter": "problem.parameter",
    "Prediction": "uncertainty.prediction",
    "Problem": "problem.problem",
    "Profile": "uncertainty.profiles",
    "ReferenceSignal": "problem.reference_signals",
    "ResidualDiagnostics": "uncertainty.residuals",
    "RunningCost": "problem.costs",
    "SearchProgress": "modes.search_run",
    "Status": "optimize",
    "Step": "fit.search_record",
    "Stiffness": "discretization.stiffness",
    "TerminalConstraint": "problem.costs",
    "TerminalCost": "problem.costs",
    "Termination": "fit.termination",
    "Trajectory": "fit.trajectory",
    "TransitionCost": "problem.costs",
    "Validation": "strategy.validation",
    "Verdict": "uncertainty.verdict",
    "bootstrap": "batch.bootstrap_study",
    "calibrate": "online.calibration",
    "check_derivatives": "uncertainty.derivative_check",
    "compare": "estimation.comparison",
    "design": "experiment_design.search",
    "estimate": "estimation.estimating",
    "estimate_many": "batch.logs",
    "evaluate": "fit.evaluation",
    "evaluate_on_guards": "fit.guards",
    "find_modes": "modes.search",
    "from_epoch": "problem.dates",
    "identifiability": "uncertainty.identification",
    "insertion": "modes.rates",
    "monte_carlo": "batch.monte_carlo_study",
    "multistart": "batch.starts",
    "predict": "uncertainty.prediction",
    "profile": "uncertainty.profiles",
    "read_log": "io.logs.reader",
    "replay": "online.log",
    "simulate": "fit.simulation",
}
"""Public names, and the modules that have them."""

__all__ = list(_MODULES)


def __getattr__(name: str) -> object:
    """Import a public name from its module (PEP 562); called once for each, since it is then an attribute."""
    if name not in _MODULES:
        raise AttributeError(f"module 'switchfit' has no attribute {name!r}", name=name)
    value = getattr(_import_module(f"switchfit.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names only; rooms are imported by their full names."""
    return sorted([*__all__, "__version__"])
