"""A model of one's own: a heater is switched off at an unknown time; when, and how fast does the room cool?"""

import numpy as np

import switchfit as sf

room = sf.HybridSystem(
    modes={
        "on": lambda t, x, p: p["heating"] - p["cooling"] * (x - 15.0),
        "off": lambda t, x, p: -p["cooling"] * (x - 15.0),
    },
    initial_state=[15.0],
    state_names=("T",),
    state_units=("°C",),
)

# A log with a reading every 2 minutes: heated at 0.5 °C/min for 43 minutes, noise 0.1 °C.
minutes = np.arange(0.0, 120.0, 2.0)
heated = 25.0 * (1.0 - np.exp(-0.02 * np.minimum(minutes, 43.0)))
exact = 15.0 + heated * np.exp(-0.02 * np.maximum(minutes - 43.0, 0.0))
log = sf.Measurements(minutes, exact + 0.1 * np.random.default_rng(1).standard_normal(len(minutes)), sigma=0.1)

run = sf.Experiment(log, mode_sequence=("on", "off"), transition_times=(30.0,), time_unit="min")
rates = {"heating": sf.Parameter(0.3, unit="°C/min"), "cooling": sf.Parameter(0.05, unit="1/min")}
problem = sf.Problem(room, run, parameters=rates)

if __name__ == "__main__":
    print(sf.estimate(problem))
