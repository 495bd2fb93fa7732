"""A folder with a problem file that uses most keys, its model and its log."""

PROBLEM = """
model = "room.py:room"
[parameters]
heating = { value = 0.3, lower = 0.0, upper = 2.0, unit = "K/min" }
cooling = 0.05
[[experiments]]
name = "monday"
mode_sequence = ["on", "off"]
transition_times = [{ value = 3.0, lower = 1.0, upper = 5.0 }]
t0 = 0.0
tf = 6.0
[[experiments.data]]
file = "log.csv"
time = "t"
columns = ["T"]
observe = ["T"]
sigma = 0.1
[options]
min_duration = 0.5
rtol = 1e-7
max_iterations = 50
"""

ROOM = """
import switchfit as sf
def on(t, x, p):
    return p["heating"] - p["cooling"] * (x - 15.0)
def off(t, x, p):
    return -p["cooling"] * (x - 15.0)
def make(start=15.0, on=on, names=("T",)):
    return sf.HybridSystem(modes={"on": on, "off": off}, initial_state=[start], state_names=names)
def fahrenheit(t, x, p):
    return 32.0 + 1.8 * x
def broken_factory():
    raise RuntimeError("no data today")
def broken_mode(t, x, p):
    return x * undefined_name
room, broken, nameless = make(), make(on=broken_mode), make(names=None)
seven = 7
"""

LOG = """t,T,sd,u
0,15.0,0.1,1
1,15.4,0.1,1
2,,0.2,1
3,16.3,0.1,1
4,16.2,0.1,0
5,16.1,0.1,0
6,16.0,0.1,0
"""


def fill_folder(folder):
    """Write the problem, its model and its log into a folder, and return it."""
    (folder / "problem.toml").write_text(PROBLEM)
    (folder / "room.py").write_text(ROOM)
    (folder / "log.csv").write_text(LOG)
    return folder
