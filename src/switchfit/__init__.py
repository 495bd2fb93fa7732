"""switchfit: when did the system switch mode, and what were its parameters?"""

from switchfit.batch.fits import Fits
from switchfit.batch.logs import estimate_many
from switchfit.batch.posterior import LogPosterior, log_posterior
from switchfit.batch.resampling import Bootstrap, bootstrap
from switchfit.batch.simulated import MonteCarlo, monte_carlo
from switchfit.batch.starts import Multistart, multistart
from switchfit.discretization.mesh import Stiffness
from switchfit.engine.protocol import Evaluation
from switchfit.estimation.estimator import Estimate
from switchfit.fit.evaluator import evaluate
from switchfit.fit.guards import GuardedEvaluation, evaluate_on_guards
from switchfit.fit.result import Step
from switchfit.fit.termination import Kink, Termination
from switchfit.fit.trajectory import Comparison, Trajectory, simulate
from switchfit.io.logs.log import Log
from switchfit.io.logs.reader import read_log
from switchfit.modes.rates import Insertion, insertion
from switchfit.modes.result import ModeFit, ModeSearch
from switchfit.modes.search import SearchProgress, find_modes
from switchfit.modes.status import ModeEnding, ModeStatus, ModeWarning
from switchfit.optimize import Status
from switchfit.problem.constraints import ActiveConstraint
from switchfit.problem.data import (
    Input,
    Measurements,
    ReferenceSignal,
    RunningCost,
    TerminalConstraint,
    TerminalCost,
    TransitionCost,
)
from switchfit.problem.dates import from_epoch
from switchfit.problem.experiment import Experiment, Parameter
from switchfit.problem.jump import Jump
from switchfit.problem.priors import LogNormal, Normal
from switchfit.problem.problem import Problem
from switchfit.problem.system import HybridSystem
from switchfit.runtime.issue import Issue
from switchfit.runtime.xla import compile_small_loops_whole
from switchfit.strategy.choice import estimate
from switchfit.strategy.comparison import ModelComparison, Nested, compare
from switchfit.strategy.validation import InputCorrelation, Validation
from switchfit.uncertainty.certificate import Certificate
from switchfit.uncertainty.derivative_check import DerivativeCheck, check_derivatives
from switchfit.uncertainty.identification import Direction, Identifiability, identifiability
from switchfit.uncertainty.prediction import Prediction, predict
from switchfit.uncertainty.profiles import Profile, profile
from switchfit.uncertainty.residuals import ChannelResiduals, ResidualDiagnostics
from switchfit.uncertainty.verdict import Verdict

compile_small_loops_whole()

# The report registers functions that write and draw results. It is imported last: if it came first, all other modules
# would be imported a few levels deeper, which takes a tenth longer.
from switchfit import report as _report  # noqa: E402, F401

__version__ = "0.1.0"

__all__ = [
    "ActiveConstraint",
    "Bootstrap",
    "Certificate",
    "ChannelResiduals",
    "Comparison",
    "DerivativeCheck",
    "Direction",
    "Estimate",
    "Evaluation",
    "Experiment",
    "Fits",
    "GuardedEvaluation",
    "HybridSystem",
    "Identifiability",
    "Input",
    "InputCorrelation",
    "Insertion",
    "Issue",
    "Jump",
    "Kink",
    "Log",
    "LogNormal",
    "LogPosterior",
    "Measurements",
    "ModeEnding",
    "ModeFit",
    "ModeSearch",
    "ModeStatus",
    "ModeWarning",
    "ModelComparison",
    "MonteCarlo",
    "Multistart",
    "Nested",
    "Normal",
    "Parameter",
    "Prediction",
    "Problem",
    "Profile",
    "ReferenceSignal",
    "ResidualDiagnostics",
    "RunningCost",
    "SearchProgress",
    "Status",
    "Step",
    "Stiffness",
    "TerminalConstraint",
    "TerminalCost",
    "Termination",
    "Trajectory",
    "TransitionCost",
    "Validation",
    "Verdict",
    "bootstrap",
    "check_derivatives",
    "compare",
    "estimate",
    "estimate_many",
    "evaluate",
    "evaluate_on_guards",
    "find_modes",
    "from_epoch",
    "identifiability",
    "insertion",
    "log_posterior",
    "monte_carlo",
    "multistart",
    "predict",
    "profile",
    "read_log",
    "simulate",
]


def __dir__() -> list[str]:
    """Return the public names only; rooms are imported by their full names."""
    return sorted([*__all__, "__version__"])
