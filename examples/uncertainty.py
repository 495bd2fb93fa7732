"""How certain is it? A heater is switched off at an unknown time; twelve noisy readings say when, and how surely.

Prints intervals, a profile likelihood, a bootstrap, what the data determine worst and tests of the residuals;
with a folder as its argument it writes the figures there.
"""

import sys
from pathlib import Path

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

# A reading every 10 minutes: heated at 0.5 °C/min for 43 minutes, noise 0.8 °C.
minutes = np.arange(5.0, 120.0, 10.0)
heated = 25.0 * (1.0 - np.exp(-0.02 * np.minimum(minutes, 43.0)))
exact = 15.0 + heated * np.exp(-0.02 * np.maximum(minutes - 43.0, 0.0))
log = sf.Measurements(
    minutes, exact + 0.8 * np.random.default_rng(4).standard_normal(len(minutes)), sigma=0.8, names=("T",)
)

run = sf.Experiment(log, mode_sequence=("on", "off"), transition_times=(40.0,), t0=0.0, tf=120.0, time_unit="min")
problem = sf.Problem(
    room,
    run,
    parameters={
        "heating": sf.Parameter(0.4, lower=0.0, unit="°C/min"),
        "cooling": sf.Parameter(0.03, lower=0.0, unit="1/min"),
    },
)


def main(folder: Path | None = None) -> None:
    """Fit, print everything that comes with the fit, and draw it."""
    print(sf.identifiability(problem), end="\n\n")  # before any fit
    estimate = sf.estimate(problem)
    print(estimate, end="\n\n")
    profile = estimate.profile("tau_1")
    print(profile, end="\n\n")
    print("99 % interval of tau_1:", profile.interval(0.99), end="\n\n")
    study = sf.bootstrap(estimate, 1000)
    print(study, end="\n\n")
    print(estimate.residuals, end="\n\n")
    prediction = estimate.predict([60.0, 115.0])
    print("T at 60 and 115 min:", prediction.outputs[:, 0], "+-", prediction.output_errors[:, 0], end="\n\n")
    print(estimate.certificate)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        estimate.plot().savefig(folder / "fit.svg")
        profile.plot().savefig(folder / "profile.svg")
        study.plot().savefig(folder / "bootstrap.svg")
        estimate.plot_residuals().savefig(folder / "residuals.svg")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
