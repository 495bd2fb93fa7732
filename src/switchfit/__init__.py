"""switchfit: when did the system switch mode, and what were its parameters?"""

from switchfit.data import Input, Measurements, ReferenceSignal, RunningCost, TerminalCost
from switchfit.evaluate import Evaluation, evaluate
from switchfit.experiment import Experiment, Parameter
from switchfit.problem import Problem
from switchfit.simulate import Trajectory, simulate
from switchfit.system import HybridSystem
