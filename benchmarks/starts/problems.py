"""All problems of the study, by name."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from benchmarks.starts import applications, bounces, logs, minimum_time, switching, unknown_noise, vehicles
from benchmarks.starts.case import Case, Make

PROBLEMS: dict[str, Make] = {
    "two-turns": vehicles.two_turns,
    "two-turns-anywhere": vehicles.two_turns_anywhere,
    "paper-reference": vehicles.paper_reference,
    "paper-positions": vehicles.paper_positions,
    "fishing": switching.fishing,
    "linear": switching.linear,
    "oscillator": switching.oscillator,
    "tosses": logs.ten_tosses,
    "ball-guards": bounces.ball_on_guards,
    "ball": bounces.ball_without_guards,
    "thermostat": logs.thermostat,
    "epidemic": logs.epidemic,
    "runs": logs.many_runs,
    "enzyme": logs.enzyme,
    "spring": unknown_noise.spring,
    "growth": unknown_noise.growth,
    "predators": unknown_noise.predators,
    "friction": applications.friction,
    "tanks": applications.tanks,
    "house": applications.house,
    "doses": applications.doses,
    "battery": applications.battery,
    "reference-signal": applications.reference,
    "rest-to-rest": minimum_time.rest_to_rest,
    "pendulum": minimum_time.pendulum,
    "van-der-pol": minimum_time.van_der_pol,
}


@cache
def _build(name: str) -> Case:
    return PROBLEMS[name]()


def build_case(name: str, count: int | None = None) -> Case:
    """Return a problem of the study with its own number of starts, or with the first `count` of them.

    It is built once in a process and kept with its compiled programs.
    """
    case = _build(name)
    return case if count is None else replace(case, starts=case.starts[:count])
