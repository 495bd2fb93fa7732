"""Saving a fit and loading it gives the same fit, to the bit; what is no saved fit is refused with the reason."""

import json
import random
import re
from dataclasses import fields, replace
from pathlib import Path
from types import GenericAlias

import numpy as np
import pytest
from numpy.typing import NDArray

import switchfit as sf
from support.equal_fits import CERTIFICATE, assert_same
from support.fits_by_hand import NOTHING, comparison_of, made, several, trajectory_of
from support.models import RAMP
from support.places import SAVED
from switchfit.estimation.estimates import Estimate
from switchfit.fit.result import Fit
from switchfit.fit.termination import Kink
from switchfit.io.saved_fits import FIT_FORMAT, FIT_VERSION, save_fit
from switchfit.optimize import Status
from switchfit.runtime.issue import Issue
from switchfit.runtime.json_records import find_dtype
from switchfit.uncertainty.certificate import Certificate


def round_trip(fit: Fit, folder: Path) -> tuple[Fit, Certificate]:
    save_fit(fit, CERTIFICATE, folder / "fit.json")
    found = Estimate.load(folder / "fit.json")
    return get_fit(found), found.certificate


def get_fit(estimate: Estimate) -> Fit:
    """Return what a file holds of an estimate."""
    return Fit(**{f.name: getattr(estimate, f.name) for f in fields(Fit)})


def with_everything_odd() -> Fit:
    """Empty and scalar arrays, negative zeros, the smallest numbers, missing samples, unknown sigma, kinks."""
    trajectory = trajectory_of(("plain", "ünïcode", "a longer name"))
    comparison = comparison_of(trajectory, sigma=None)
    empty = replace(comparison, times=np.zeros(0), measured=np.zeros((0, 2)), fitted=np.zeros((0, 2)))
    return made(
        parameters={"scalar": np.array(-0.0), "matrix": np.array([[5e-324, 1 / 3], [-np.inf, 1e308]]),
                    "none": np.zeros((2, 0, 3)), "one": np.array([0.1 + 0.2])},
        parameter_units={"scalar": "1", "matrix": "°C", "none": "", "one": "m"}, fixed=("scalar", "none"),
        trajectories=(trajectory,), comparisons=((comparison, empty),), transition_times=(np.array([-0.0, 7.0]),),
        integration_error=np.inf,
        kinks=(Kink("tau_1", -0.0, -1.5, 2.5),), active=CERTIFICATE.active, flat_direction=(("mu", -0.7),),
        sigma_known=None, theta_units=("", "°C", "m/s²"),
        free_basis=np.zeros((3, 0)), status=Status.LINE_SEARCH_FAILED, violated=(("x at the end", np.nan),),
        reason=Issue("jump", ("mu",), {"before": 1.0, "after": np.inf, "at": (0.1 + 0.2,)}),
    )  # fmt: skip


@pytest.mark.parametrize(
    "fit",
    [made(), made(sigma_known=False), several(3), made(**NOTHING), with_everything_odd(), made(comparisons=((),))],
    ids=["plain", "sigma unknown", "several", "no numbers", "odd", "no data"],
)
def test_loading_gives_the_same_fit(fit, tmp_path):
    loaded, certificate = round_trip(fit, tmp_path)
    assert_same(fit, loaded)
    assert_same(CERTIFICATE, certificate)


def test_arrays_are_found_by_what_either_numpy_calls_them():
    """From 2.5 on `NDArray` is an alias that is its own origin."""
    assert [find_dtype(kind) for kind in (NDArray[np.bool_], GenericAlias(NDArray, (np.float64,)))] == [bool, float]
    assert find_dtype(float) is None


def test_the_file_is_strict_and_readable(tmp_path):
    save_fit(made(), CERTIFICATE, tmp_path / "fit.json")
    text = (tmp_path / "fit.json").read_text(encoding="utf-8")
    content = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert (content["format"], content["version"]) == (FIT_FORMAT, FIT_VERSION)
    assert content["fit"]["lower"] == ["-Infinity", "-Infinity", 0.05]
    assert content["fit"]["status"] == "CONVERGED"
    assert content["certificate"]["smallest_eigenvalue"] == "NaN"
    assert '    "theta": [4.0, 7.0, 0.8],\n' in text


@pytest.mark.usefixtures("quick_certificates")
def test_a_real_fit_comes_back(tmp_path):
    times = np.linspace(0.05, 1.95, 20)
    data = sf.Measurements(times, 3.0 * np.minimum(times, 1.23) + 0.01 * np.cos(40 * times))
    problem = sf.Problem(RAMP, sf.Experiment(data, ("up", "rest"), (1.0,), 0.0, 2.0), {"v": 2.0})
    estimate = sf.estimate(problem)
    estimate.save(tmp_path / "fit.json")
    kind, verdict = next(iter(json.loads((tmp_path / "fit.json").read_text(encoding="utf-8")).items()))
    assert (kind, verdict["level"], verdict["text"]) == ("verdict", estimate.verdict.level, str(estimate.verdict))
    loaded = sf.Estimate.load(tmp_path / "fit.json")
    assert loaded.verdict == estimate.verdict
    for field in fields(Fit):
        assert_same(getattr(estimate.complete(), field.name), getattr(loaded, field.name))
    assert_same(estimate.certificate, loaded.certificate)
    assert str(loaded) == str(estimate)
    with pytest.raises(ValueError, match=r"loaded without its model: load it with Estimate.load\(path, problem="):
        loaded.profile("v")
    with_model = sf.Estimate.load(tmp_path / "fit.json", problem=problem)
    np.testing.assert_allclose(with_model.predict([1.0]).outputs, estimate.predict([1.0]).outputs, rtol=1e-9)
    other = sf.Problem(RAMP, problem.experiments[0], {"v": sf.Parameter(2.0, fixed=True)})
    with pytest.raises(ValueError, match="holds the unknowns tau_1, v, the problem has tau_1: it is the fit of"):
        sf.Estimate.load(tmp_path / "fit.json", problem=other)


APPROVED = SAVED / "fit.json"
"""A fit of two runs that ended at a bound and at a kink, without its provenance, beside its whole report."""


def test_a_file_in_the_repository_prints_the_same_report_as_ever():
    loaded, text = sf.Estimate.load(APPROVED), APPROVED.with_suffix(".txt").read_text(encoding="utf-8")
    assert f"{loaded.report(full=True)}\n\n{loaded.certificate}\n" == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "not valid JSON"),
        (b"[" * 100_000, "not valid JSON"),
        (b"[1, 2]", 'no entry "format": "switchfit fit"'),
        (b'{"format": "switchfit fit", "version": 7}', "of version 7; this switchfit reads version 11"),
        (b'{"format": "switchfit fit", "version": 11}', "is damaged: its content is not what was written"),
    ],
)
def test_what_is_no_saved_fit(text, message, tmp_path):
    path = tmp_path / "fit.json"
    path.write_bytes(text)
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}.*{message}"):
        Estimate.load(path)


@pytest.mark.parametrize("count", [50, pytest.param(12_000, marks=pytest.mark.fuzz)])
def test_a_file_with_damaged_bytes_is_refused_or_the_same(count, tmp_path):
    """Cut off, bits that flipped, pieces that were written twice or moved."""
    save_fit(made(), CERTIFICATE, tmp_path / "whole.json")
    whole, path = (tmp_path / "whole.json").read_bytes(), tmp_path / "fit.json"
    for number in range(count):
        rng = random.Random(number)
        data = bytearray(whole)
        a, b = sorted(rng.sample(range(len(data)), 2))
        near = min(b, a + 50)
        cut, flip = (b, len(data), b""), (a, a + 1, bytes([data[a] ^ 1 << rng.randrange(8)]))
        repeat, remove, zeros = (b, b, data[a:near]), (a, near, b""), (a, b, bytes(b - a))
        begin, end, new = rng.choice([cut, flip, repeat, remove, zeros])
        data[begin:end] = new
        path.write_bytes(data)
        refusal = f"{path} is whole"
        try:
            assert_same(made(), get_fit(Estimate.load(path)))
        except ValueError as error:
            refusal = str(error)
        assert refusal.startswith(f"{path} is "), f"damage {number}"


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content["fit"].update(cost=28.000000001),
        lambda content: content["certificate"].update(kinks=[]),
        lambda content: content.pop("seal"),
    ],
)
def test_what_is_not_as_it_was_written(change, tmp_path):
    path = tmp_path / "fit.json"
    save_fit(made(), CERTIFICATE, path)
    content = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(content))
    assert Estimate.load(path).cost == 28.0, "in another layout"
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="is damaged: its content is not what was written"):
        Estimate.load(path)
