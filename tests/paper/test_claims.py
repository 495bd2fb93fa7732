"""The paper's claims, each checked with fewer repetitions than `switchfit paper` makes."""

import json
from unittest.mock import Mock

import numpy as np
import pytest
from typer.testing import CliRunner

import switchfit as sf
from support.places import ROOT
from switchfit.cli import app
from switchfit.paper import convergence, magic_reference, noise, oscillator, trials
from switchfit.paper.parts import PARTS, Part
from switchfit.paper.runner import format_comparison, run
from switchfit.paper.table_rows import TableRow
from switchfit.paper.tyre_logs import wheel_speeds
from switchfit.paper.vehicle import NAMES, TRUTH
from switchfit.paper.vehicle_figure import compute_vehicle, draw_vehicle

COEFFICIENTS = ("eigenvalues", "undetermined", "worst")
"""What is found of the Hessian in the 16 coefficients of the Magic Formula."""


def found_by(name):
    """What a part finds, as it comes back from the file; its table and figures have to work with that."""
    part = PARTS[name]
    found = json.loads(json.dumps(part.compute(True, lambda text: None)))
    for row in part.list_rows(found):
        assert "nan" not in " ".join(row)
        assert row.ours
    for figure in part.draw(found).values():
        for ax in figure.axes:
            assert ax.get_ylabel() or ax.get_xlabel()
    return found


def test_the_vehicle_is_drawn_inside_its_axes():
    (figure,) = draw_vehicle(compute_vehicle(True, print)).values()
    figure.draw_without_rendering()
    (ax,) = figure.axes
    for patch in ax.patches:
        box = patch.get_window_extent()
        assert ax.bbox.x0 < box.x0 < box.x1 < ax.bbox.x1
        assert ax.bbox.y0 < box.y0 < box.y1 < ax.bbox.y1


@pytest.mark.slow
def test_lti_example_agrees_with_matrix_exponentials_and_exact_sqp_is_the_fastest():
    found = found_by("lti")
    assert max(found["gaps"]) < 1e-8
    assert found["error"] < 1e-8
    steepest, block, exact = (found["fits"][kind]["iterations"] for kind in ("none", "block-diagonal", "exact"))
    assert exact <= 8
    assert steepest > block > 3 * exact
    # J and DJ vanish at the truth, where D²J is positive definite: had a term of Van Loan's been lost, J would not.
    cost, gradient, hessian = oscillator.evaluate_exactly(np.array(oscillator.LTI_TRUTH))
    assert max(abs(cost), *np.abs(gradient)) < 1e-12
    assert np.linalg.eigvalsh(hessian)[0] > 0.1


@pytest.mark.slow
def test_exact_sqp_is_quadratic_and_the_block_diagonal_hessian_linear():
    found = found_by("convergence")
    fits = found["fits"]
    assert all(fit["gradient_norm"] < 1e-7 for fit in fits.values())
    for fit in fits.values():
        np.testing.assert_allclose([fit["theta"][name] for name in NAMES], TRUTH, rtol=0, atol=1e-6)
    assert fits["exact"]["iterations"] <= 12
    assert 1.7 < convergence.measure_order(fits["exact"]["history"]) < 2.4
    assert fits["block-diagonal"]["iterations"] > 20 * fits["exact"]["iterations"]
    assert 0.9 < convergence.measure_factor(fits["block-diagonal"]["history"]) < 1.0
    assert 500 < fits["none"]["iterations"] < 2000
    assert found["eigenvalues_at_start"][0] < 0 < found["descents"]
    assert fits["descent-first"]["iterations"] - found["descents"] <= 12
    assert fits["exact"]["sufficient"]


@pytest.mark.slow
def test_magic_formula_reference_gives_values_like_the_paper(monkeypatch):
    """What is found of the 16 coefficients, which takes long, is that of the documentation."""
    results = json.loads((ROOT / "docs" / "measured" / "paper.json").read_text())
    kept = {name: results["magic-formula"]["found"][name] for name in COEFFICIENTS}
    monkeypatch.setattr(magic_reference, "_coefficients", lambda speeds, say: kept)
    monkeypatch.setattr(magic_reference, "RAMPS", ((0.6, 3.4),))
    found = found_by("magic-formula")
    (slow,) = found["ramps"]
    assert abs(slow["theta"]["tau_2"] - 11.7) < 0.3  # later by the wheels' own delay
    literal, reset = found["fits"]["continuous"], found["fits"]["reset"]
    for fit in (literal, reset):
        assert fit["sufficient"]
        assert abs(fit["theta"]["tau_1"] - 5.0) < 0.15
        assert 10.0 < fit["theta"]["tau_2"] < 12.0
        assert 0.6 < fit["theta"]["mu"] < 0.85
    assert reset["rms_position_error"] < 0.2 * literal["rms_position_error"]


@pytest.mark.slow
def test_sixteen_coefficients_do_not_work():
    found = magic_reference._coefficients(wheel_speeds(), lambda text: None)
    assert found["undetermined"] > 6
    assert len(found["eigenvalues"]) == 16
    assert found["eigenvalues"][0] < 1e-12 * found["eigenvalues"][-1]


@pytest.mark.slow
def test_starts_end_at_the_truth_or_at_the_bound_of_mu_and_strategies_lead_away_from_there():
    found = found_by("starts")
    for way, ends in found["ways"].items():
        assert sum(end["count"] for end in ends) == found["starts"]
        np.testing.assert_allclose(ends[0]["theta"], TRUTH, rtol=0, atol=1e-5)
        assert ends[0]["count"] >= (0.98 if way == "auto" else 0.8) * found["starts"]


@pytest.mark.slow
def test_error_grows_with_noise_and_is_largest_for_mu(monkeypatch):
    monkeypatch.setattr(noise, "QUICK_NOISE_LEVELS", (0.0, 0.05, 0.25, 0.5))
    found = found_by("noise")
    levels = found["levels"]
    rms = np.array([level["rms"] for level in levels])
    assert np.all(np.diff(rms, axis=0) > 0)
    assert np.all(rms[1:, 2] > rms[1:, :2].max(axis=1))
    assert all(level["converged"] > 0.9 * found["runs"] for level in levels[1:])
    assert max(rms[0]) > 1e-4, "interpolated samples do not hold the truth"
    # Samples after the slip say more of mu than the four in it.
    mu = {line["label"]: line["mu"] for line in found["samples"]}
    assert max(mu["0 to 15 s"], mu["0 to 15 s without those in slip"]) < 0.5 * mu["0 to 10 s"]


@pytest.mark.slow
def test_trials_converge_in_fewer_than_fifteen_iterations(monkeypatch):
    monkeypatch.setattr(trials, "TRIALS", trials.TRIALS[2:4])
    found = found_by("trials")
    for trial in found["trials"]:
        fit = trial["fit"]
        assert fit["iterations"] < 15
        assert fit["gradient_norm"] < 1e-7
        assert fit["sufficient"]
        assert 0.6 < fit["theta"]["mu"] < 0.85


def test_an_interrupted_run_goes_on_with_what_is_missing_and_one_part_alone_leaves_the_others(tmp_path, monkeypatch):
    def build(name, compute):
        def list_rows(found):
            return [TableRow(name, "1 | 2", str(found["value"]))]

        return Part(f"part {name}", lambda quick, say: say("begins") or compute(), list_rows=list_rows)

    first, second = Mock(side_effect=[{"value": 1}, {"value": 3}]), Mock(side_effect=[KeyboardInterrupt, {"value": 2}])
    monkeypatch.setattr("switchfit.paper.runner.PARTS", {"lti": build("lti", first), "noise": build("noise", second)})
    said = []
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, quick=True, say=said.append)
    assert said == ["[1/2] part lti: begins", "[2/2] part noise: begins"]
    for only, values in ((None, [1, 2]), ("lti", [3, 2])):
        results = run(tmp_path, quick=only is None, only=only)
        assert [entry["found"]["value"] for entry in results.values()] == values
        assert json.loads((tmp_path / "results.json").read_text()) == results
        assert (tmp_path / "table.md").read_text() == format_comparison(results)
    assert [entry["quick"] for entry in results.values()] == [False, True]
    assert "| lti | 1 \\| 2 | 3 |" in format_comparison(results)


def test_interrupted_study_is_not_taken_for_a_result(monkeypatch):
    monkeypatch.setattr(noise, "fit_locally", Mock(return_value=Mock(status=sf.Status.INTERRUPTED)))
    with pytest.raises(KeyboardInterrupt):
        noise.compute_noise(True, lambda text: None)


def test_command_writes_figures_and_table_and_names_the_parts(tmp_path):
    runner = CliRunner()
    out = runner.invoke(app, ["paper", "--quick", "--only", "lti", "--out", str(tmp_path / "new")])
    assert out.exit_code == 0, out.output
    assert "| LTI: the correct values are found |" in out.stdout
    names = {path.name for path in (tmp_path / "new").iterdir()}
    assert names == {"lti.pdf", "lti.png", "results.json", "table.md"}
    wrong = runner.invoke(app, ["paper", "--only", "fig7", "--out", str(tmp_path)])
    assert wrong.exit_code == 2
    assert f"there is no part 'fig7'; the parts are {', '.join(PARTS)}" in wrong.output
