"""The examples, run, and searches for the mode sequence in their logs; those of online estimation last."""

import json
import runpy
import sys
from dataclasses import replace
from types import SimpleNamespace as Fields

import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import switchfit as sf
from support.models import fit_problem
from support.places import EXAMPLES
from switchfit import cli
from switchfit.io.problem_file.loading import load_problem


def load(name):
    """What the script of an example defines."""
    return runpy.run_path(str(EXAMPLES / name))


def fit_file(name):
    """What `switchfit fit --json` says of the problem file of an example."""
    return json.loads(CliRunner().invoke(cli.app, ["fit", str(EXAMPLES / name), "--json"]).stdout)


def test_own_model_finds_what_made_its_log(capsys):
    estimate = sf.estimate(load("own_model.py")["problem"])
    assert np.all(np.abs(estimate.theta - [43.0, 0.5, 0.02]) < 3 * estimate.standard_errors)
    assert capsys.readouterr().out == ""


@pytest.mark.slow
def test_scripts_of_other_examples(tmp_path, capsys):
    """When heaters were switched; a manoeuvre that is over sooner than the paper's; figures."""
    heaters = load("heaters/heaters.py")
    power = sf.estimate(heaters["make_problem"]("power"), strategy="local")
    np.testing.assert_allclose(power.transition_times[0], heaters["read"]()[2], atol=3.0)
    module = load("manoeuvre/manoeuvre.py")
    assert module["measure_durations"](module["find"]((2.5, 3.0, 3.5))) == pytest.approx((3.17, 2.85), abs=0.02)
    load("uncertainty.py")["main"](tmp_path)
    assert "Profile of tau_1" in capsys.readouterr().out
    assert {path.stem for path in tmp_path.iterdir()} == {"bootstrap", "fit", "profile", "residuals"}


def test_two_turns_end_at_what_made_their_log():
    simulated = load("two_turns/make_log.py")["simulate"]()
    log = np.loadtxt(EXAMPLES / "two_turns" / "drive.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(log, simulated, atol=6e-4)
    found = fit_file("two_turns/problem.toml")
    assert found["verdict"] == "good"
    for unknown, truth in zip(found["unknowns"], (5.3, 10.4, 15.3, 19.5, 0.8, 0.6, 0.72), strict=True):
        assert abs(unknown["value"] - truth) < 3 * unknown["standard_error"]


def test_tosses_share_a_friction_coefficient_or_do_not():
    """The first three of the ten."""
    module = load("tosses/tosses.py")
    tosses = module["read"]()[:3]
    each = sf.estimate(module["make_problem"](tosses, one_mu=False))
    # As fits of each toss alone by other software have it.
    np.testing.assert_allclose(list(each.parameters.values()), [0.2162, 0.2153, 0.2034], atol=2e-4)
    one = fit_problem(module["make_problem"](tosses), start=module["start_from"](each), success=True)
    assert len(one.theta) == len(each.theta) - 2
    assert 0.2034 < one.parameters["mu"] < 0.2162
    F, probability = module["is_one_enough"](one, each)
    assert F > 50.0
    assert probability < 1e-6


@pytest.mark.slow
def test_a_toss_from_release_has_its_impacts_where_they_are_seen():
    module = load("toss/release.py")
    estimate = fit_problem(module["make_problem"](), success=True)
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
    module = load("husky/husky.py")
    make_problem, collect, score = module["make_problem"], module["collect"], module["score"]
    fits = {name: sf.estimate(make_problem((0, 1, 4), name), strategy="local") for name in ("centers", "turn slip")}
    scores = {name: score(*collect(fit.validate(make_problem((12, 16), name)))) for name, fit in fits.items()}
    assert fits["turn slip"].parameters["turn_slip"] > 0.3
    assert min(scores["turn slip"][:3]) > 0.8
    assert scores["turn slip"][3] < 0.7 * scores["centers"][3]


def test_husky_limits_commands_and_static_fit_is_as_published():
    module = load("husky/husky.py")
    controller = module["fit_controller"]()
    for step in module["OTHER"]:
        command, _, wheels = module["read_command"](module["read"](step), step)
        np.testing.assert_allclose(module["settle"](command, *controller), wheels, atol=0.2)
    static = {"turn_slip": 0.0} | module["STATIC"]
    found = [module["DRIVE"].modes["slip"](0.0, np.zeros(3), static, wheels) for wheels in np.eye(2)]
    np.testing.assert_allclose(found, [[0.047, -0.0093, -0.093], [0.073, 0.0095, 0.095]], rtol=1e-6)


@pytest.mark.slow
def test_covid_finds_the_rates_and_the_first_two_dates_that_were_published():
    module = load("covid/covid.py")
    estimate, published = sf.estimate(module["make_problem"]()), module["PUBLISHED"]
    assert estimate.cost < 551.2  # the lowest of 64 starts
    assert estimate.residuals.channels[0].white
    dates, rates = np.array(estimate.transition_dates[0], dtype="datetime64[m]"), estimate.parameters["lambda"]
    noons = np.array([f"{published[f'tau_{k}']}T12:00" for k in (1, 2, 3)], dtype="datetime64[m]")
    assert np.all(np.abs((dates - noons) / np.timedelta64(1, "D")) < [1.0, 2.0, 4.5])
    np.testing.assert_allclose(rates, [published[f"lambda[{k}]"] for k in range(4)], rtol=0.12)
    assert rates[2] > module["RECOVERY"] > rates[3]  # it grows until the third change
    early = sf.estimate(module["make_problem"](until="2020-04-09"))
    assert abs(early.transition_times[0][2] - float(published["tau_3"][-2:])) < 2.0


@pytest.mark.usefixtures("fits_one_by_one")
def test_ball_finds_the_restitution_from_guesses_that_are_30_ms_off(tmp_path):
    example = load("ball/ball.py")
    np.testing.assert_array_equal(example["read"](), example["simulate"]())  # the log is what the script says
    bounces = example["bounce_times"](**example["TRUTH"])
    assert np.abs(example["make_guesses"](100)[:, :8] - bounces).max() > 0.029
    estimate = sf.estimate(example["make_problem"]())
    assert estimate.verdict.level == "good"
    truth = np.concatenate([bounces, [0.8, 1.0, 0.5]])
    assert np.all(np.abs(estimate.theta - truth) < 3 * estimate.standard_errors)
    example["plot"](estimate, sf.bootstrap(estimate, 10)).savefig(tmp_path / "ball.svg")
    closed = example["heights"](np.array([0.2, 3.4]), **example["TRUTH"])
    path = sf.simulate(example["make_problem"](truth))
    np.testing.assert_allclose(np.interp([0.2, 3.4], path.times, path.states[:, 0]), closed, atol=1e-3)


@pytest.mark.slow
def test_fishing_from_a_fleet_in_port(tmp_path):
    """J with eight switches is that of the best published times."""
    module = load("fishing/fishing.py")
    search = module["find"](module["make_problem"](rtol=1e-11, atol=1e-13))
    costs = module["costs_of"](search)
    assert (costs[8], costs[10]) == pytest.approx((1.345295218283, 1.344846158737), abs=1e-10, rel=0)
    assert [module["choose"](costs, c) for c in (0.03, 0.003, 0.0003)] == [2, 4, 8]
    module["plot"](search).savefig(tmp_path / "fishing.svg")


@pytest.fixture(scope="module")
def terrain():
    return load("terrain/terrain.py")


@pytest.mark.slow
def test_terrain_problem_file_ends_at_the_border():
    found = fit_file("terrain/problem.toml")
    assert found["verdict"] == "good"
    assert found["unknowns"][0]["value"] == pytest.approx(3.41, abs=0.05)


@pytest.mark.slow
def test_terrain_goes_onto_the_green_and_back(terrain):
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


# --- searches for the mode sequence in measured logs whose answer is known --------------------------------------------


def flight(t, x, p):
    speed, heading = x[2], x[3]
    return jnp.stack([speed * jnp.cos(heading), speed * jnp.sin(heading), 0.0 * speed, 0.0 * speed])


@pytest.mark.slow
@pytest.mark.parametrize("number", range(10))
def test_a_toss_slides_and_sticks(number):
    """With successions it is what the cube did; without, BIC as it stands wants more, and nothing is found.

    "flight" is in the library, and a single mode is the first guess.
    """
    example = load("tosses/tosses.py")
    known = example["make_problem"]([example["read"]()[number]])
    modes = {"flight": flight, **known.system.modes}
    cube = sf.HybridSystem(modes, known.system.initial_state, state_names=known.system.state_names)
    run = replace(known.experiments[0], mode_sequence=("slide",), transition_times=())
    problem = sf.Problem(cube, run, known.parameters)
    found = sf.find_modes(problem, successions={"flight": "slide", "slide": "stick"}, max_switches=6)
    assert found.mode_sequence == ("slide", "stick")
    assert found.status in (sf.ModeStatus.FOUND, sf.ModeStatus.AMBIGUOUS)
    assert found.best.cost <= sf.estimate(known).cost * (1 + 1e-6)
    free = sf.find_modes(problem, max_switches=6)
    assert free.status is sf.ModeStatus.AMBIGUOUS
    assert min(free.fitted, key=lambda fit: fit.bic).switches > 1


@pytest.mark.slow
def test_the_spreading_rate_changed_three_times():
    loaded = load_problem(EXAMPLES / "covid" / "search.toml", searched=True)
    search = sf.find_modes(loaded.problem, max_switches=5, **loaded.library)
    assert search.success
    assert search.mode_sequence == ("phase 0", "phase 1", "phase 2", "phase 3")
    assert [fit.switches for fit in search.fitted] == [0, 1, 2, 3, 4, 5]
    bic, mbic, aicc = ([getattr(fit, name) for fit in search.fitted] for name in ("bic", "mbic", "aicc"))
    assert [int(np.argmin(values)) for values in (bic, mbic, aicc)] == [3, 3, 3]
    # Of another implementation, which does not count the noise: log 51 less.
    np.testing.assert_array_less(bic[:4], np.array([315.6, 228.6, 212.7, 196.1]) + np.log(51) + 1.0)
    known = sf.estimate(load("covid/covid.py")["make_problem"]())
    np.testing.assert_allclose(search.best.cost, known.cost, rtol=1e-6)
    np.testing.assert_allclose(search.transition_times[0], known.transition_times[0], atol=1e-3)


@pytest.mark.slow
def test_the_order_of_the_heaters_is_found_one_heater_at_a_time(monkeypatch):
    """In a free library they are interchangeable: at best J is right, the names are not, and nothing is found."""
    monkeypatch.syspath_prepend(EXAMPLES / "heaters")
    order = load("heaters/order.py")
    known = sf.estimate(order["heaters"].make_problem("power"))
    search, free = order["search"](first="0/0", successions=order["one_at_a_time"]()), order["search"]()
    assert search.mode_sequence == tuple(order["heaters"].MODES)
    np.testing.assert_allclose(search.best.cost, known.cost, rtol=1e-6)
    np.testing.assert_allclose(search.transition_times[0], known.transition_times[0], atol=0.02)
    assert search.status is sf.ModeStatus.NOT_EXPLAINED
    eight = next(fit for fit in search.fitted if fit.switches == 8)
    assert eight.bic < search.chosen[0].bic - 40.0, "as they stand, the criteria want two crutches"
    assert [warning.switches for warning in search.warnings if warning.kind == "discounted"] == [6]
    assert free.status in (sf.ModeStatus.NOT_EXPLAINED, sf.ModeStatus.AMBIGUOUS)
    assert min(fit.cost for fit in free.fitted if fit.switches == 6) < 1.01 * known.cost


# --- online estimation: the simulated vehicle, the surfaces, the Husky, and the ROS 2 node ---------------------------


def list_messages():
    """A drive of 12 s with a turn: commands 20 times a second, positions 10 times; from 5 s on slip is 0.4."""
    rng, place, yaw = np.random.default_rng(0), np.array([3.0, -2.0]), 0.4
    for k in range(241):
        t = k / 20
        turns, speed = 0.1 * (t >= 2.0), 1.5 * (0.6 if t >= 5.0 else 1.0)
        if k % 2 == 0:
            stamp = Fields(sec=1_700_000_000 + k // 20, nanosec=k % 20 * 50_000_000)
            x, y = place + 0.03 * rng.standard_normal(2)
            turned = Fields(x=0.0, y=0.0, z=np.sin(0.5 * yaw), w=np.cos(0.5 * yaw))
            pose = Fields(position=Fields(x=x, y=y, z=0.0), orientation=turned)
            yield Fields(header=Fields(stamp=stamp), pose=Fields(pose=pose))
        yield Fields(twist=Fields(linear=Fields(x=1.5), angular=Fields(z=turns)))
        for _ in range(10):  # to the next command
            place = place + 0.005 * speed * np.array([np.cos(yaw), np.sin(yaw)])
            yaw += 0.005 * turns


def test_messages_give_samples_and_modes():
    """Times in seconds since the first position, the command that holds then; the slip is found, and when it began."""
    node = load("online/ros2_node.py")
    adapter, follower, samples, said = node["Adapter"](), node["Follower"](), [], []
    for message in list_messages():
        if hasattr(message, "twist"):
            adapter.take_command(message)
            follower.adapter.take_command(message)
        else:
            samples.append(adapter.take_odometry(message))
            said.append(follower.take_odometry(message))
    np.testing.assert_allclose([t for t, _, _ in samples], 0.1 * np.arange(121), atol=1e-12)
    assert samples[0][2] == {"vx": 0.0, "wz": 0.0}, "before the first command"
    assert samples[30][2] == {"vx": 1.5, "wz": 0.1}
    last = json.loads(node["describe"](said[-1]))
    assert (last["mode"], last["status"]) == ("slip", "TRACKING")
    assert last["since"] == pytest.approx(5.0, abs=0.15)
    assert last["slip"]["value"] == pytest.approx(0.4, abs=4 * last["slip"]["error"])
    alarms = [now.alarm for now in said[1:] if now.alarm is not None]
    assert [alarm.mode for alarm in alarms] == ["slip"]


def test_the_simulated_vehicle_online():
    """When it is known that the vehicle slips: as the page says."""
    example = load("online/online.py")
    log = sf.replay(example["simulate"](0), window=6.0)
    assert log.now.mode_sequence == ("stick", "slip", "stick")
    assert (log.delays(example["SLIPS"]) <= [0.9, 0.6]).all()
    assert abs(log.now.parameters["mu"] - 0.7) < 4 * log.now.standard_errors["mu"]


@pytest.mark.parametrize("name", ["green_table_00", pytest.param("green_table_24", marks=pytest.mark.slow)])
def test_surfaces_online(name, monkeypatch):
    """The border is known within half a second, without another alarm."""
    monkeypatch.syspath_prepend(str(EXAMPLES / "terrain"))
    example = load("terrain/online.py")
    log = example["follow"](name, 50.0)
    delays, others = example["count"](log, example["BORDERS"][name])
    assert delays[0] < 0.5
    assert others == 0
    sys.modules.pop("terrain", None)


def test_the_husky_online():
    """Ten changes of how fast it turns are known after at most 1.6 s; the lidar, which is not used, agrees."""
    example = load("online/husky.py")
    drive = example["chain"]()
    log = sf.replay(example["make_problem"](drive), **example["SETTINGS"])
    times = log.now.transition_times
    assert len(times) == 10
    assert (log.delays(times - 0.1) < 1.7).all(), "0.1 s: what the first guess of a time may be off"
    assert len(log.retracted) == len(log.alarms) - len(times) <= 2
    ratios = np.array(example["measure_ratios"](drive, times))
    assert ratios[1::2].max() < 0.08 < ratios[::2].min()
