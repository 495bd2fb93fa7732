"""In which order were two heaters set to new powers? The mode sequence found from two thermistors, and when it is not.

The log has six steps among seven pairs of settings. The search knows the pairs, and not their order. Run it:

    python examples/heaters/order.py
"""

from dataclasses import replace

import heaters

import switchfit as sf

DURATION = 30.0  # s, for which each setting but the first is kept at least, in the last search; off is never again


def make_problem():
    """The model with a power for each pair of settings; a single mode is the first guess of the sequence."""
    known = heaters.make_problem("power")
    run = replace(known.experiments[0], mode_sequence=heaters.MODES[:1], transition_times=())
    return sf.Problem(known.system, run, known.parameters)


def one_at_a_time():
    """The settings that may follow each: those that differ in one heater alone."""
    named = dict(zip(heaters.MODES, heaters.SETTINGS, strict=True))
    return {
        mode: tuple(other for other, then in named.items() if sum(a != b for a, b in zip(now, then, strict=True)) == 1)
        for mode, now in named.items()
    }


def search(**what):
    """A search over the order of the settings."""
    return sf.find_modes(make_problem(), max_switches=8, **what)


if __name__ == "__main__":
    known = heaters.make_problem("power")
    print(f"In the recorded order: J = {sf.estimate(known).cost:.2f}\n")
    structure = {"first": "0/0", "successions": one_at_a_time()}
    steady = {
        "first": "0/0",
        "successions": {mode: [m for m in after if m != "0/0"] for mode, after in one_at_a_time().items()},
        "min_duration": dict.fromkeys(heaters.MODES[1:], DURATION),
    }
    for title, what in (
        ("Any mode after any other", {}),
        ("One heater at a time, at first both are off", structure),
        (f"The same, never both off again, and each other setting for {DURATION:g} s or more", steady),
    ):
        print(f"{title}\n\n{search(**what)}\n")
