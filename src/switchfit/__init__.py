"""switchfit: when did the system switch mode, and what were its parameters?"""

from switchfit.batch.bootstrap import Bootstrap, bootstrap
from switchfit.batch.fits import Fits
from switchfit.batch.logs import estimate_many
from switchfit.batch.monte_carlo import MonteCarlo, monte_carlo
from switchfit.batch.multistart import Multistart, multistart
from switchfit.check import DerivativeCheck, check_derivatives
from switchfit.data import Input, Measurements, ReferenceSignal, RunningCost, TerminalConstraint, TerminalCost
from switchfit.estimate import Estimate, estimate
from switchfit.evaluate import Evaluation, evaluate
from switchfit.experiment import Experiment, Parameter
from switchfit.guards import GuardedEvaluation, evaluate_on_guards
from switchfit.identifiability import Direction, Identifiability, identifiability
from switchfit.optimize import Status
from switchfit.prediction import Prediction, predict
from switchfit.priors import LogNormal, Normal
from switchfit.problem import Problem
from switchfit.profile import Profile, profile
from switchfit.residuals import ChannelResiduals, ResidualDiagnostics
from switchfit.result import Certificate
from switchfit.simulate import Comparison, Trajectory, simulate
from switchfit.system import HybridSystem
from switchfit.xla import compile_small_loops_whole

compile_small_loops_whole()

__version__ = "0.1.0"

__all__ = [
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
    "LogNormal",
    "Measurements",
    "MonteCarlo",
    "Multistart",
    "Normal",
    "Parameter",
    "Prediction",
    "Problem",
    "Profile",
    "ReferenceSignal",
    "ResidualDiagnostics",
    "RunningCost",
    "Status",
    "TerminalConstraint",
    "TerminalCost",
    "Trajectory",
    "bootstrap",
    "check_derivatives",
    "estimate",
    "estimate_many",
    "evaluate",
    "evaluate_on_guards",
    "identifiability",
    "monte_carlo",
    "multistart",
    "predict",
    "profile",
    "simulate",
]
