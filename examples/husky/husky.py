"""Twenty commanded steps of a skid-steered Clearpath Husky: delay, lag and slip, shared by all steps.

Steps 0 to 9 are fitted jointly, steps 10 to 19 are predicted. Each variant of the model is judged by steps that it has
not seen: those of 0 to 9 left out one by one, and 10 to 19. Run it:

    python examples/husky/husky.py
"""

import csv
from pathlib import Path

import numpy as np
import scipy.optimize

import switchfit as sf
from switchfit.models import differential_drive

FITTED, OTHER = tuple(range(10)), tuple(range(10, 20))
# The files are chains of windows of 2 s, of which some have the command of the window before. In the last 2 s of these
# files the wheels follow the command of the next file; in 6 and 9 they follow from t = 0 the one stated from 2 s on.
ONE_COMMAND = {4: 6.0, 7: 6.0, 11: 6.0, 12: 4.0, 14: 6.0, 15: 4.0, 17: 6.0, 19: 6.0}
SLOW = (15, 17, 19)  # steps that turn two to four times slower than others with the same wheel speeds
RADIUS = 0.165  # m, of a wheel
LATE = 0.15  # s, by which encoders are later than poses; chosen by cross-validation
# A static fit to 141 of the 201 steps of that drive, in terms of centers of rotation: v = 0.047 w_l + 0.073 w_r,
# yaw rate = 0.095 w_r - 0.093 w_l, lateral speed 0.10 of the yaw rate.
STATIC = {"y_l": 0.073 / 0.095, "y_r": -0.047 / 0.093, "x_v": -0.10}
STATIC |= {f"alpha_{side}": k * (STATIC["y_l"] - STATIC["y_r"]) / RADIUS for side, k in (("l", 0.093), ("r", 0.095))}
KNOWN = {"y_l": 0.285, "y_r": -0.285, "x_v": 0.0, "alpha_l": 1.0, "alpha_r": 1.0, "turn_slip": 0.0}
FREE = {
    "y_l": sf.Parameter(0.9, lower=0.1, upper=5.0, unit="m"),
    "y_r": sf.Parameter(-0.8, lower=-5.0, upper=-0.1, unit="m"),
    "x_v": sf.Parameter(0.0, lower=-1.0, upper=1.0, unit="m"),
    "alpha_l": sf.Parameter(0.9, lower=0.3, upper=1.5, unit="1"),
    "alpha_r": sf.Parameter(0.9, lower=0.3, upper=1.5, unit="1"),
    "turn_slip": sf.Parameter(0.3, lower=-0.5, upper=1.0, unit="1"),
}
NOISE = {
    "sigma_position": sf.Parameter(0.15, lower=0.01, upper=3.0, unit="m"),
    "sigma_yaw": sf.Parameter(0.15, lower=0.01, upper=9.0, unit="rad"),
}
VARIANTS = {  # what is estimated; the rest is as in KNOWN
    "ideal": (),
    "static": (),
    "centers": ("y_l", "y_r"),
    "centers, x_v": ("y_l", "y_r", "x_v"),
    "centers, x_v, alphas": ("y_l", "y_r", "x_v", "alpha_l", "alpha_r"),
    "turn slip": ("y_l", "y_r", "turn_slip"),
    "turn slip, x_v": ("y_l", "y_r", "x_v", "turn_slip"),
    "turn slip, x_v, alphas": ("y_l", "y_r", "x_v", "alpha_l", "alpha_r", "turn_slip"),
}
CHOSEN = "turn slip, x_v"
DRIVE = differential_drive(radius=RADIUS, alpha_l="alpha_l", alpha_r="alpha_r", turn_slip="turn_slip")


def read(step):
    """Columns of a step by name, yaw without jumps of 2 pi."""
    path = Path(__file__).with_name(f"step_{step:03d}.csv")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    log = dict(zip(rows[0], np.array(rows[1:], dtype=float).T, strict=True))
    return log | {"yaw_rad": np.unwrap(log["yaw_rad"])}


def find_new(*columns):
    """Rows in which any of the columns has a new value; the others only hold the last one."""
    values = np.column_stack(columns)
    return np.flatnonzero(np.r_[True, np.any(np.diff(values, axis=0) != 0.0, axis=1)])


def read_poses(log, until=np.inf):
    """Times of new poses after the first, which is zero by definition, and the poses (K, 3)."""
    values = np.column_stack([log["x_m"], log["y_m"], log["yaw_rad"]])
    new = find_new(values)[1:]
    new = new[log["t_s"][new] <= until]
    return log["t_s"][new], values[new]


def read_wheels(log):
    """Times of new wheel speeds, and the speeds (K, 2)."""
    values = np.column_stack([log["wheel_left"], log["wheel_right"]])
    new = find_new(values)
    return log["t_s"][new], values[new]


def observe_pose(t, x, p):
    return x[:3]


def observe_wheels(t, x, p):
    return x[3:5]


def make_run(step, late=LATE, grip_first=False):
    """A step that is driven by the measured wheel speeds; perhaps its wheels grip at first, for an unknown time."""
    log = read(step)
    times, wheels = read_wheels(log)
    return sf.Experiment(
        sf.Measurements(
            *read_poses(log),
            observe=observe_pose,
            sigma=["sigma_position", "sigma_position", "sigma_yaw"],
            names=("x", "y", "yaw"),
            units=("m", "m", "rad"),
        ),
        ("grip", "slip") if grip_first else ("slip",),
        (sf.Parameter(0.2, lower=0.0, upper=log["t_s"][-1]),) if grip_first else None,
        t0=0.0,
        tf=log["t_s"][-1],
        inputs=sf.Input(times - late, wheels),
        name=f"step{step}",
    )


def make_problem(steps=FITTED, variant=CHOSEN, **settings):
    """The joint problem of some steps; what a variant does not estimate has its known value."""
    known = KNOWN | (STATIC if variant == "static" else {})
    values = {
        name: FREE[name] if name in VARIANTS[variant] else sf.Parameter(known[name], fixed=True) for name in KNOWN
    }
    return sf.Problem(DRIVE, [make_run(step, **settings) for step in steps], values | NOISE)


def settle(command, gain, turn_gain, widest, fastest):
    """Wheel speeds at which the robot's controller settles: it limits the difference, then scales both speeds."""
    mean, half = gain * (command[0] + command[1]) / 2, turn_gain * (command[1] - command[0]) / 2
    half = np.clip(half, -widest / 2, widest / 2)
    speeds = np.array([mean - half, mean + half])
    return speeds * min(1.0, fastest / max(np.abs(speeds).max(), 1e-9))


def read_command(log, step):
    """The command of a step, its last time, and the mean wheel speeds of the last second before that."""
    last = ONE_COMMAND.get(step, log["t_s"][-1])
    late = (log["t_s"] > last - 1.0) & (log["t_s"] <= last)
    speeds = [np.mean(log[name][late]) for name in ("wheel_left", "wheel_right")]
    return np.array([log["cmd_left"][-1], log["cmd_right"][-1]]), last, np.array(speeds)


def fit_controller(steps=FITTED):
    """The four constants of `settle`, by least squares on the speeds at which the wheels of some steps settled."""
    commands, _, speeds = zip(*(read_command(read(step), step) for step in steps), strict=True)
    found = scipy.optimize.least_squares(
        lambda z: np.ravel([settle(c, *z) - s for c, s in zip(commands, speeds, strict=True)]), [1.5, 0.9, 7.0, 6.0]
    )
    return found.x


COMMANDED = differential_drive(modes="slip", speeds="commanded", radius=RADIUS, turn_slip="turn_slip", delay="delay")


def make_commanded_run(step, controller):
    """A step that is driven by its command; encoders are data, and late."""
    log = read(step)
    command, last, _ = read_command(log, step)
    target = command if controller is None else settle(command, *controller)
    times, wheels = read_wheels(log)
    seen = (times > 0.5) & (times <= last)
    return sf.Experiment(
        [
            sf.Measurements(
                *read_poses(log, last),
                observe=observe_pose,
                sigma=["sigma_position", "sigma_position", "sigma_yaw"],
                names=("x", "y", "yaw"),
                units=("m", "m", "rad"),
            ),
            sf.Measurements(
                times[seen],
                wheels[seen],
                observe=observe_wheels,
                sigma="sigma_wheels",
                names=("w_l", "w_r"),
                units=("rad/s", "rad/s"),
                delay="late",
            ),
        ],
        ("wait", "slip"),
        (0.35,),
        t0=0.0,
        tf=last,
        inputs=sf.Input([0.0], target[None]),
        initial_state=[0.0, 0.0, 0.0, *wheels[0]],
        name=f"step{step}",
    )


def make_commanded(steps=FITTED, controller=None):
    """The joint problem of some steps, driven by their commands, as they are or as the controller limits them."""
    unknown = {
        "delay": sf.Parameter(0.35, lower=0.01, upper=1.0, unit="s"),
        "lag": sf.Parameter(0.3, lower=0.02, upper=2.0, unit="s"),
        "late": sf.Parameter(0.15, lower=0.0, upper=0.4, unit="s"),
        "sigma_wheels": sf.Parameter(0.5, lower=0.01, upper=9.0, unit="rad/s"),
    }
    values = {name: FREE[name] for name in VARIANTS[CHOSEN]} | unknown | NOISE
    return sf.Problem(COMMANDED, [make_commanded_run(step, controller) for step in steps], values)


def collect(found, until=None):
    """Measured poses (K, 3) and errors (K, 3) of all runs of a fit or a validation, perhaps up to a time of each."""
    parts = []
    for name, (poses, *_) in zip(found.run_names, found.comparisons, strict=True):
        kept = poses.times <= (until or {}).get(int(name[4:]), np.inf)
        parts.append((poses.measured[kept], poses.fitted[kept] - poses.measured[kept]))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def score(poses, errors):
    """Shares of the variance of x, y and yaw that are explained, rms error of position (m) and of yaw (rad)."""
    shares = 1 - np.sum(errors**2, axis=0) / np.sum((poses - poses.mean(axis=0)) ** 2, axis=0)
    return *shares, np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))), np.sqrt(np.mean(errors[:, 2] ** 2))


def leave_out(steps=FITTED, **settings):
    """Poses and errors of each step, predicted by a fit of the others, and the parameters of these fits."""
    parts, parameters = [], []
    for step in steps:
        others = sf.estimate(make_problem([k for k in steps if k != step], **settings), strategy="local")
        parts.append(collect(others.validate(make_problem([step], **settings))))
        parameters.append(others.parameters)
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True)), parameters


def find_jackknife_errors(parameters):
    """Standard errors of parameters from the spread of the fits that leave out one step each."""
    values = np.array([list(each.values()) for each in parameters], dtype=float)
    return dict(zip(parameters[0], np.sqrt((len(values) - 1) * values.var(axis=0)), strict=True))


def print_scores(name, *scores):
    print(f"{name:31}", *(" ".join(f"{number:6.2f}" for number in numbers) for numbers in scores), sep=" | ")


def compare_variants():
    """Print how each variant, and each lateness of the encoders, predicts steps that it has not seen."""
    print("Shares of x, y, yaw; rms of position (m) and yaw (rad): steps 0 to 9, left out one by one | steps 10 to 19")
    candidates = {name: {"variant": name} | ({"late": 0.0} if not VARIANTS[name] else {}) for name in VARIANTS}
    candidates |= {f"{CHOSEN}, {late:.2f} s late": {"late": late} for late in (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3)}
    for name, settings in candidates.items():
        fit = sf.estimate(make_problem(**settings), strategy="local")
        check = fit.validate(make_problem(OTHER, **settings))
        print_scores(name, score(*leave_out(**settings)[0]), score(*collect(check)))


def print_estimates(fit):
    """Print the parameters with three standard errors, and how far residuals and wheels are from what is assumed."""
    jackknife = find_jackknife_errors(leave_out()[1])
    naive = dict(zip(fit.theta_names, fit.standard_errors, strict=True))
    corrected = dict(zip(fit.theta_names, fit.corrected_standard_errors, strict=True))
    print("\nEstimates, with standard errors as if residuals were independent, corrected, and by leaving out steps")
    for name in VARIANTS[CHOSEN]:
        errors = " ".join(f"± {found[name]:.3f}" for found in (naive, corrected, jackknife))
        print(f"  {name:10} {fit.parameters[name]:7.3f} {errors}")


def print_validation(check):
    """Print chi-square of steps 10 to 19, the correlation of neighbors, and how late the wheels are against the IMU."""
    neighbors = [channel.correlation for channel in check.residuals.channels]
    white = sum(channel.white for channel in check.residuals.channels)
    print(f"\nchi-square {check.chi_square:.0f} for {check.freedom} degrees of freedom; {check.verdict.level}")
    print(f"  neighboring residuals correlated by {min(neighbors):.2f} to {max(neighbors):.2f}; {white} channels white")
    found = [correlate_imu(late) for late in range(9)]
    print("  correlation of the IMU's yaw rate with wheels that are later by 0, 0.05, ... s:", *np.round(found, 3))


def correlate_imu(late, steps=FITTED + OTHER):
    """Correlation of the yaw rate of the IMU with the difference of the wheel speeds, so many samples later."""
    pairs = [read(step) for step in steps]
    rates = np.concatenate([log["imu_yaw"][: len(log["t_s"]) - late] for log in pairs])
    wheels = np.concatenate([(log["wheel_right"] - log["wheel_left"])[late:] for log in pairs])
    return np.corrcoef(rates, wheels)[0, 1]


def compare_inputs(check):
    """Print how commands, instead of the wheel speeds that followed, predict the same rows; and a first mode grip."""
    controller = fit_controller()
    print("\nController: gain {:.2f}, of the difference {:.2f}; limits {:.2f} and {:.2f} rad/s".format(*controller))
    for steps in (FITTED, OTHER):
        pairs = [read_command(read(step), step) for step in steps]
        errors = [settle(command, *controller) - speeds for command, _, speeds in pairs]
        print(f"  wheels of steps {steps[0]} to {steps[-1]} settle there within {np.std(errors):.3f} rad/s")
    print("Steps 10 to 19 until the next command")
    print_scores("measured wheel speeds", score(*collect(check, ONE_COMMAND)))
    for name, constants in (("commands, limited by controller", controller), ("commands as they are", None)):
        fit = sf.estimate(make_commanded(controller=constants), strategy="local")
        print_scores(name, score(*collect(fit.validate(make_commanded(OTHER, constants)))))
        found = dict(zip(fit.theta_names, fit.standard_errors, strict=True))
        names = ("delay", "lag", "late")
        print("   ", ", ".join(f"{name} {fit.parameters[name]:.3f} ± {found[name]:.3f} s" for name in names))
    print("All of steps 10 to 19")
    print_scores("slip", score(*collect(check)))
    fit = sf.estimate(make_problem(grip_first=True), strategy="local")
    gripped = fit.validate(make_problem(OTHER, grip_first=True))
    print_scores("grip, then slip", score(*collect(gripped)))
    print("    grip ends (s) in steps 0 to 9 at", " ".join(f"{times[0]:.2f}" for times in fit.transition_times))
    print("    and, estimated from steps 10 to 19,", " ".join(f"{time:.2f}" for time in gripped.theta[: len(OTHER)]))
    print_scores("these parameters, no grip", score(*collect(fit.validate(make_problem(OTHER)))))


def print_worst(check):
    """Print the error of each step, and how fast it turns for the difference of its wheel speeds."""
    print("\nstep  rms x, y (m), yaw (rad)  turn, integrated IMU (rad)  yaw rate over wheel difference")
    for name, (poses,) in zip(check.run_names, check.comparisons, strict=True):
        log = read(int(name[4:]))
        step = log["t_s"][1]
        wheels = step * np.sum(log["wheel_right"] - log["wheel_left"])
        turn = log["yaw_rad"][-1]
        errors = " ".join(f"{number:5.2f}" for number in np.sqrt(np.mean(poses.residuals**2, axis=0)))
        imu = step * np.sum(log["imu_yaw"])
        print(f"{name:7} {errors}         {turn:5.2f} {imu:5.2f}               {turn / wheels:.3f}")
    easy = [k for k, name in enumerate(check.run_names) if int(name[4:]) not in SLOW]
    for what, runs in (("all", range(len(check.run_names))), ("but " + ", ".join(map(str, SLOW)), easy)):
        poses = np.concatenate([check.comparisons[k][0].measured for k in runs])
        errors = np.concatenate([check.comparisons[k][0].residuals for k in runs])
        print_scores(what, score(poses, errors))


def plot(check, other, steps=(11, 12, 18, 17)):
    """Figure of some steps: path and yaw, measured, predicted, and predicted by another model."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 5.2), layout="constrained")
    for k, step in enumerate(steps):
        poses, others = (each.comparisons[each.run_names.index(f"step{step}")][0] for each in (check, other))
        above, below = figure.add_subplot(2, len(steps), k + 1), figure.add_subplot(2, len(steps), len(steps) + k + 1)
        above.plot(*poses.measured[:, :2].T, ".", color="0.5", markersize=4, label="measured")
        above.plot(*others.curve[:, :2].T, color="C1", linewidth=1, label="static fit")
        above.plot(*poses.curve[:, :2].T, color="C0", label="turn slip")
        above.set(title=f"step {step}", xlabel="x (m)", ylabel="y (m)" if k == 0 else None)
        above.set_aspect("equal", adjustable="datalim")
        below.plot(poses.times, poses.measured[:, 2], ".", color="0.5", markersize=4)
        below.plot(others.curve_times, others.curve[:, 2], color="C1", linewidth=1)
        below.plot(poses.curve_times, poses.curve[:, 2], color="C0")
        below.set(xlabel="t (s)", ylabel="yaw (rad)" if k == 0 else None)
        if k == 0:
            below.legend(*above.get_legend_handles_labels(), frameon=False)
    figure.align_ylabels()
    # Equal scales change the tick labels after the layout: leave room for them on the left.
    figure.get_layout_engine().set(rect=(0.02, 0.0, 0.98, 1.0))
    return figure


def main():
    """Print the tables of the page on this example."""
    compare_variants()
    fit = sf.estimate(make_problem(), strategy="local")
    print_estimates(fit)
    check = fit.validate(make_problem(OTHER))
    print_validation(check)
    compare_inputs(check)
    print_worst(check)
    static = sf.estimate(make_problem(variant="static", late=0.0), strategy="local")
    print_worst(static.validate(make_problem(OTHER, "static", late=0.0)))


if __name__ == "__main__":
    main()
