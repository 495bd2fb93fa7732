"""A problem file whose mode sequence is searched for."""

import numpy as np

from support.models import approach

PROBLEM = """
model = "model.py:system"
[parameters]
a = { value = 0.5, lower = 0.0, unit = "1/s" }
b = 0.6
c = 0.1
[[experiments]]
t0 = 0.0
tf = 8.0
[[experiments.data]]
file = "log.csv"
time = "t"
columns = ["T"]
sigma = 0.02
[library]
first = "rise"
min_duration = 0.2
[library.successions]
rise = ["fall", "drift"]
fall = "rise"
"""


def simulate(times, knots, sigma=0.02, seed=0):
    """Rise and fall in turn, with a = 0.7 and b = 0.4."""
    values = approach(times, knots, (0.7, 0.4), (3.0, 0.0), start=0.5)
    return values + sigma * np.random.default_rng(seed).normal(size=len(times))


TIMES = np.linspace(0.05, 7.95, 60)


MODEL = """
import jax.numpy as jnp
import switchfit as sf
def rise(t, x, p):
    return p["a"] * (3.0 - x)
def fall(t, x, p):
    return -p["b"] * x
def drift(t, x, p):
    return jnp.stack([p["c"]])
def twice(t, x, p):
    return 2.0 * x
def drop(t, x, p):
    return x - 0.3
def pushed(t, x, p, u):
    return p["a"] * (u - x)
system = sf.HybridSystem({"rise": rise, "fall": fall, "drift": drift}, [0.5], state_names=("T",))
driven = sf.HybridSystem(
    {"pushed": pushed, "fall": lambda t, x, p, u: -p["b"] * x}, [sf.Parameter(0.4, lower=0.0)], state_names=("T",)
)
def build():
    data = sf.Measurements([0.0, 1.0, 2.0], [[0.5], [1.0], [2.0]], sigma=0.1)
    return sf.Problem(system, sf.Experiment(data, ["rise", "fall"], [1.0]), {"a": 1.0, "b": 1.0, "c": 0.0})
"""


def fill(folder, text=PROBLEM):
    """Write a problem, its model and its log of rise -> fall -> rise into a folder, and return it."""
    (folder / "problem.toml").write_text(text)
    (folder / "model.py").write_text(MODEL)
    write_log(folder / "log.csv", simulate(TIMES, (2.5, 5.5)))
    return folder


def write_log(path, *columns, times=TIMES, names=("T",)):
    rows = [",".join(map(repr, row)) for row in np.stack([times, *columns], axis=1).tolist()]
    path.write_text("\n".join([",".join(("t", *names)), *rows]) + "\n")
