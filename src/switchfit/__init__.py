"""switchfit: when did the system switch mode, and what were its parameters?"""

from switchfit.batch.fits import Fits
from switchfit.batch.logs import estimate_many
from switchfit.batch.monte_carlo import MonteCarlo, monte_carlo
from switchfit.batch.multistart import Multistart, multistart
from switchfit.check import DerivativeCheck, check_derivatives
from switchfit.data import Input, Measurements, ReferenceSignal, RunningCost, TerminalCost
from switchfit.estimate import Estimate, estimate
from switchfit.evaluate import Evaluation, evaluate
from switchfit.experiment import Experiment, Parameter
from switchfit.optimize import Status
from switchfit.priors import LogNormal, Normal
from switchfit.problem import Problem
from switchfit.result import Certificate
from switchfit.simulate import Comparison, Trajectory, simulate
from switchfit.system import HybridSystem
from switchfit.xla import compile_small_loops_whole

compile_small_loops_whole()

__version__ = "0.1.0"

__all__ = [
    "Certificate",
    "Comparison",
    "DerivativeCheck",
    "Estimate",
    "Evaluation",
    "Experiment",
    "Fits",
    "HybridSystem",
    "Input",
    "LogNormal",
    "Measurements",
    "MonteCarlo",
    "Multistart",
    "Normal",
    "Parameter",
    "Problem",
    "ReferenceSignal",
    "RunningCost",
    "Status",
    "TerminalCost",
    "Trajectory",
    "check_derivatives",
    "estimate",
    "estimate_many",
    "evaluate",
    "monte_carlo",
    "multistart",
    "simulate",
]
