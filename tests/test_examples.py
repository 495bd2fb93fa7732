"""The examples, run."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import switchfit as sf
from switchfit import cli

EXAMPLES = Path(__file__).parent.parent / "examples"


def test_own_model_finds_what_made_its_log(capsys):
    estimate = sf.estimate(runpy.run_path(str(EXAMPLES / "own_model.py"))["problem"])
    assert np.all(np.abs(estimate.theta - [43.0, 0.5, 0.02]) < 3 * estimate.standard_errors)
    assert capsys.readouterr().out == ""


@pytest.mark.slow
def test_scripts_of_other_examples(tmp_path, capsys):
    """When heaters were switched; a manoeuvre that is over sooner than the paper's; figures."""
    heaters = runpy.run_path(str(EXAMPLES / "heaters" / "heaters.py"))
    power = sf.estimate(heaters["make_problem"]("power"), strategy="local")
    np.testing.assert_allclose(power.transition_times[0], heaters["read"]()[2], atol=3.0)
    module = runpy.run_path(str(EXAMPLES / "manoeuvre" / "manoeuvre.py"))
    assert module["measure_durations"](module["find"]((2.5, 3.0, 3.5))) == pytest.approx((3.17, 2.85), abs=0.02)
    runpy.run_path(str(EXAMPLES / "uncertainty.py"))["main"](tmp_path)
    assert "Profile of tau_1" in capsys.readouterr().out
    assert {path.stem for path in tmp_path.iterdir()} == {"bootstrap", "fit", "profile", "residuals"}


def test_two_turns_end_at_what_made_their_log():
    folder = EXAMPLES / "two_turns"
    simulated = runpy.run_path(str(folder / "make_log.py"))["simulate"]()
    np.testing.assert_allclose(np.loadtxt(folder / "drive.csv", delimiter=",", skiprows=1), simulated, atol=6e-4)
    found = json.loads(CliRunner().invoke(cli.app, ["fit", str(folder / "problem.toml"), "--json"]).stdout)
    assert found["verdict"] == "good"
    for unknown, truth in zip(found["unknowns"], (5.3, 10.4, 15.3, 19.5, 0.8, 0.6, 0.72), strict=True):
        assert abs(unknown["value"] - truth) < 3 * unknown["standard_error"]


def test_tosses_share_a_friction_coefficient_or_do_not():
    """The first three of the ten."""
    module = runpy.run_path(str(EXAMPLES / "tosses" / "tosses.py"))
    tosses = module["read"]()
    assert len(tosses) == 10
    each = sf.estimate(module["make_problem"](tosses[:3], one_mu=False))
    assert each.success
    # As fits of each toss alone by other software have it.
    np.testing.assert_allclose(list(each.parameters.values()), [0.2162, 0.2153, 0.2034], atol=2e-4)
    one = sf.estimate(module["make_problem"](tosses[:3]), start=module["start_from"](each))
    assert one.success
    assert len(one.theta) == len(each.theta) - 2 == 16
    assert 0.2034 < one.parameters["mu"] < 0.2162
    F, probability = module["is_one_enough"](one, each)
    assert F > 50.0
    assert probability < 1e-6


@pytest.mark.slow
def test_a_toss_from_release_has_its_impacts_where_they_are_seen():
    module = runpy.run_path(str(EXAMPLES / "toss" / "release.py"))
    estimate = sf.estimate(module["make_problem"]())
    assert estimate.success
    assert not estimate.active
    np.testing.assert_allclose(estimate.transition_times[0][:5], module["SEEN"], atol=0.005)
    # From its flat part alone 0.2162, and it sticks at 0.351 + 0.351 s.
    assert estimate.parameters["mu"] == pytest.approx(0.2162, abs=0.003)
    assert estimate.transition_times[0][5] == pytest.approx(0.702, abs=0.01)
    assert np.all(estimate.comparisons[0][0].rmse < 2.5e-4)
    # The residuals are no noise, and the report says so.
    assert estimate.verdict.level == "doubtful"
    assert "is correlated: the model is slightly wrong" in str(estimate.verdict)


@pytest.mark.slow
def test_husky_loses_speed_in_turns():
    """Three of the ten steps, and two others."""
    module = runpy.run_path(str(EXAMPLES / "husky" / "husky.py"))
    make_problem, collect, score = module["make_problem"], module["collect"], module["score"]
    fits = {name: sf.estimate(make_problem((0, 1, 4), name), strategy="local") for name in ("centers", "turn slip")}
    scores = {name: score(*collect(fit.validate(make_problem((12, 16), name)))) for name, fit in fits.items()}
    assert fits["turn slip"].parameters["turn_slip"] > 0.3
    assert min(scores["turn slip"][:3]) > 0.8
    assert scores["turn slip"][3] < 0.7 * scores["centers"][3]
    # The IMU has yaw rates, whose integral is the yaw of the lidar.
    for step in (*module["FITTED"], *module["OTHER"]):
        log = module["read"](step)
        assert np.sum(log["imu_yaw"]) * 0.05 == pytest.approx(log["yaw_rad"][-1], abs=0.3)


def test_husky_limits_commands_and_static_fit_is_as_published():
    module = runpy.run_path(str(EXAMPLES / "husky" / "husky.py"))
    controller = module["fit_controller"]()
    for step in module["OTHER"]:
        command, _, wheels = module["read_command"](module["read"](step), step)
        np.testing.assert_allclose(module["settle"](command, *controller), wheels, atol=0.2)
    static = {"turn_slip": 0.0} | module["STATIC"]
    for wheels in np.eye(2):
        v_x, v_y, turn = module["DRIVE"].modes["slip"](0.0, np.zeros(3), static, wheels)
        v, rate = wheels @ [0.047, 0.073], wheels @ [-0.093, 0.095]
        np.testing.assert_allclose([v_x, v_y, turn], [v, 0.1 * rate, rate], rtol=1e-6)


@pytest.mark.slow
def test_covid_finds_the_rates_and_the_first_two_dates_that_were_published():
    module = runpy.run_path(str(EXAMPLES / "covid" / "covid.py"))
    estimate = sf.estimate(module["make_problem"]())
    assert estimate.success
    assert estimate.cost < 551.2  # the lowest of 64 starts
    dates, rates = np.array(estimate.transition_dates[0], dtype="datetime64[m]"), estimate.parameters["lambda"]
    published = module["PUBLISHED"]
    noons = np.array([f"{published[f'tau_{k}']}T12:00" for k in (1, 2, 3)], dtype="datetime64[m]")
    assert np.all(np.abs((dates - noons) / np.timedelta64(1, "D")) < [1.0, 2.0, 4.5])
    np.testing.assert_allclose(rates, [published[f"lambda[{k}]"] for k in range(4)], rtol=0.12)
    assert rates[2] > module["RECOVERY"] > rates[3]  # it grows until the third change
    early = sf.estimate(module["make_problem"](until="2020-04-09"))
    assert abs(early.transition_times[0][2] - float(published["tau_3"][-2:])) < 2.0
    assert estimate.residuals.channels[0].white


@pytest.mark.usefixtures("fits_one_by_one")
def test_ball_finds_the_restitution_from_guesses_that_are_30_ms_off(tmp_path):
    example = runpy.run_path(str(EXAMPLES / "ball" / "ball.py"))
    np.testing.assert_array_equal(example["read"](), example["simulate"]())  # the log is what the script says
    assert np.abs(example["make_guesses"](100)[:, :8] - example["bounce_times"](**example["TRUTH"])).max() > 0.029
    estimate = sf.estimate(example["make_problem"]())
    assert estimate.verdict.level == "good"
    truth = np.concatenate([example["bounce_times"](**example["TRUTH"]), [0.8, 1.0, 0.5]])
    assert np.all(np.abs(estimate.theta - truth) < 3 * estimate.standard_errors)
    example["plot"](estimate, sf.bootstrap(estimate, 10)).savefig(tmp_path / "ball.svg")
    closed = example["heights"](np.array([0.2, 3.4]), **example["TRUTH"])
    path = sf.simulate(example["make_problem"](truth))
    np.testing.assert_allclose(np.interp([0.2, 3.4], path.times, path.states[:, 0]), closed, atol=1e-3)


@pytest.mark.slow
def test_fishing_from_a_fleet_in_port(tmp_path):
    """J with eight switches is that of the best published times."""
    module = runpy.run_path(str(EXAMPLES / "fishing" / "fishing.py"))
    search = module["find"](module["make_problem"](rtol=1e-11, atol=1e-13))
    costs = module["costs_of"](search)
    expected = {0: 6.062277, 1: 3.136445, 2: 1.382755, 4: 1.349674, 6: 1.346318, 10: 1.344846158737}
    for switches, cost in expected.items():
        assert costs[switches] == pytest.approx(cost, abs=1e-6 if switches < 10 else 1e-10)
    assert costs[8] == pytest.approx(1.345295218283, abs=1e-10)
    assert [module["choose"](costs, c) for c in (0.03, 0.003, 0.0003)] == [2, 4, 8]
    module["plot"](search).savefig(tmp_path / "fishing.svg")


@pytest.fixture(scope="module")
def terrain():
    return runpy.run_path(str(EXAMPLES / "terrain" / "terrain.py"))


@pytest.mark.slow
def test_terrain_problem_file_ends_at_the_border():
    found = json.loads(
        CliRunner().invoke(cli.app, ["fit", str(EXAMPLES / "terrain" / "problem.toml"), "--json"]).stdout
    )
    assert found["verdict"] == "good"
    assert found["unknowns"][0]["value"] == pytest.approx(3.41, abs=0.05)


@pytest.mark.slow
def test_terrain_goes_onto_the_green_and_back(terrain, tmp_path):
    search = terrain["find"]("green_table_12")
    assert search.mode_sequence == ("neither", "both", "neither")
    assert search.status.name == "FOUND"
    assert terrain["has_crossed"](search.best)
    above, preferred = terrain["compare_numbers"](search)
    assert (above[2], preferred) == (0.0, 2)
    np.testing.assert_allclose(search.transition_times[0], [4.07, 8.97], atol=0.05)
    # A plain fit of two constant levels finds the middle of the change; the times here are where it begins.
    border, (low, high) = terrain["find_border"]("green_table_12")
    halfway = search.transition_times[0][0] + np.log(2) * search.parameters["lag_I"]
    assert low < halfway < high
    assert border == pytest.approx(halfway, abs=0.05)
    # The intervals are wider than those that take the residuals for white noise.
    assert np.all(np.diff(terrain["intervals"](search.best)) > 1.2 * np.diff(search.best.confidence_intervals()[:2]))


def test_terrain_has_two_plain_methods_beside_ours(terrain):
    """`ruptures` agrees on the times where it is told their number, and not on the number."""
    pytest.importorskip("ruptures")
    given, own = terrain["find_partition"]("green_table_12", 2)
    np.testing.assert_allclose(given, [4.28, 9.09], atol=0.02)
    assert len(own) > 2
    assert terrain["find_border"]("green_table_12")[0] == pytest.approx(given[0], abs=0.13)


@pytest.mark.slow
def test_terrain_intervals_cover(terrain):
    """With noise as correlated as the residuals; of 100, 89 to 99 do if 95 % are right."""
    corrected, _, widths = terrain["cover"]("table_gray_12", ("neither", "wheel 1", "both"), (7.98, 8.40), 100)
    assert np.all(corrected >= 0.89)
    assert np.all(widths[:, 1] < 2 * widths[:, 0])  # and are not wide beyond need
