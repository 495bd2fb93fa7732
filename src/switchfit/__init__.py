"""switchfit: when did the system switch mode, and what were its parameters?

A public name is imported from its module when it is first used: ``import switchfit`` alone imports neither JAX nor
NumPy, so that the command line answers ``--help`` at once. Type checkers read the same names in ``__init__.pyi``.
"""

from importlib import import_module as _import_module

from switchfit.runtime import compile_small_loops_whole as _compile_small_loops_whole

_compile_small_loops_whole()  # now: XLA reads its flags when it first compiles, in whatever part of the program

__version__ = "0.1.0"

_MODULES = {
    "ActiveConstraint": "problem.constraints",
    "Alarm": "online.state",
    "Bootstrap": "batch.simulated",
    "Calibration": "online.state",
    "Certificate": "uncertainty.certificate",
    "ChannelResiduals": "uncertainty.residuals",
    "Comparison": "fit.trajectory",
    "Design": "experiment_design",
    "DerivativeCheck": "uncertainty.certificate",
    "Direction": "uncertainty.certificate",
    "Estimate": "estimation.estimator",
    "Evaluation": "engine.evaluation",
    "Experiment": "problem.experiment",
    "Fits": "batch.fits",
    "GuardedEvaluation": "fit.evaluator",
    "HybridSystem": "problem.system",
    "Identifiability": "uncertainty.certificate",
    "Input": "problem.inputs",
    "InputCorrelation": "strategy.validation",
    "Insertion": "modes.rates",
    "Issue": "runtime.issue",
    "Jump": "problem.jump",
    "Kink": "fit.result",
    "Log": "io.logs.log",
    "LogNormal": "problem.priors",
    "Measurements": "problem.measurements",
    "ModeEnding": "modes.result",
    "ModeFit": "modes.result",
    "ModeSearch": "modes.result",
    "ModeStatus": "modes.result",
    "ModeWarning": "modes.result",
    "ModelComparison": "strategy.comparison",
    "MonteCarlo": "batch.simulated",
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
    "SearchProgress": "modes.search",
    "Status": "optimize",
    "Step": "fit.result",
    "Stiffness": "discretization.stiffness",
    "TerminalConstraint": "problem.costs",
    "TerminalCost": "problem.costs",
    "Termination": "fit.result",
    "Trajectory": "fit.trajectory",
    "TransitionCost": "problem.costs",
    "Validation": "strategy.validation",
    "Verdict": "uncertainty.verdict",
    "bootstrap": "batch.simulated",
    "calibrate": "online.state",
    "check_derivatives": "uncertainty.certificate",
    "compare": "strategy.comparison",
    "design": "experiment_design",
    "estimate": "strategy.choice",
    "estimate_many": "batch.study",
    "evaluate": "fit.evaluator",
    "evaluate_on_guards": "fit.evaluator",
    "find_modes": "modes.search",
    "from_epoch": "problem.dates",
    "identifiability": "uncertainty.certificate",
    "insertion": "modes.rates",
    "monte_carlo": "batch.simulated",
    "multistart": "batch.starts",
    "predict": "uncertainty.prediction",
    "profile": "uncertainty.profiles",
    "read_log": "io.logs.reader",
    "replay": "online.log",
    "simulate": "fit.trajectory",
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
