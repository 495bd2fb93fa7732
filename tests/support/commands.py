"""Commands run in this process, and a problem file of a heated room for them."""

import numpy as np
from typer.testing import CliRunner

import switchfit as sf
from support.models import temperature
from switchfit import cli

PROBLEM = """
model = "room.py:room"
[parameters]
heating = 0.4
[[experiments]]
mode_sequence = ["on", "off"]
transition_times = [2.0]
t0 = 0.0
tf = 6.0
[[experiments.data]]
file = "log.csv"
time = "t"
columns = ["T"]
sigma = 0.1
"""

ROOM = """
import switchfit as sf
def on(t, x, p):
    return p["heating"] - 0.05 * x
def off(t, x, p):
    return -0.05 * x
room = sf.HybridSystem(modes={"on": on, "off": off}, initial_state=[0.0], state_names=("T",))
"""


def log_of(switch, heating=0.5, step=0.5, noise=0.0, seed=0):
    """A room that is heated until it is switched off."""
    times = np.arange(0.25, 6.0, step)
    values = temperature(times, switch, heating, 0.05, start=0.0)
    values += noise * np.random.default_rng(seed).normal(size=len(times))
    return "t;T\ns;K\n" + "".join(f"{t:g};{v!r}\n" for t, v in zip(times, values.tolist(), strict=True))


def run(*arguments, code=None, **given):
    """Return what became of a command, whose exit code is `code` unless that does not matter."""
    result = CliRunner().invoke(cli.app, [str(argument) for argument in arguments], **given)
    assert code in (None, result.exit_code), (result.exception, result.stderr)
    return result


def catch_settings(monkeypatch, name):
    """Return what the command line gives to a function, which ends with an error."""
    got = {}

    def record(problem, callback=None, **settings):
        got.update(settings)
        raise ValueError("enough")

    monkeypatch.setattr(sf, name, record)
    return got
