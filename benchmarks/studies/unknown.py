"""The suite `unknown`: what does it cost to know neither tyres nor noise?

`joint` on cars whose front and rear stiffness are drawn from 0.6 to 1.4 of what filters assume,
over the bound that knows them; curves over one quantity each; whether intervals hold what they
promise; and, beside `joint`, FilterPy's extended Kalman filter, written as its users would: eight
states, and a camera's frame is used as it arrives, so that late frames make it another filter.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from ...envs.record import FAST, PACKET, Array, Log
from ...envs.vehicle.parameters import Vehicle
from ...estimators.design.options import DISTURBANCE, NOISE
from ...estimators.make import make_estimator
from ..harness.drives import SETTLED, call_quietly, make_filter_arguments
from ..harness.parallel import run_cases
from ..harness.results import ResultTable, Suite
from ..harness.stats import Estimate, interval, mean, mean_share, ratio_of_roots, root_mean
from ..harness.verdict import format_verdict
from ..report.study import add_rows, import_figures
from .unknown_conditions import (
    CAMERA,
    CONDITIONS,
    CURVES,
    LEVELS,
    LINEAR,
    MIX,
    PARTS,
    WITHOUT,
    Condition,
    ConditionResult,
    Curve,
    measure_all,
    run_with_bound,
)

BOUND = "the bound"


def _add_rows(
    suite: Suite,
    condition: Condition,
    result: ConditionResult,
    label: str,
    numbers: Mapping[str, Estimate],
) -> None:
    """Add rows of an estimator's numbers by metric in a condition."""
    columns = {"scenario": condition.name, "estimator": label}
    add_rows(suite, numbers, condition.env_id, n=len(result.best), **columns)


def _add_curve(suite: Suite, curve: Curve, results: Sequence[ConditionResult]) -> None:
    """Rows and a figure of a curve; no figure where plotly is not installed."""
    lines = dict[str, list[Estimate]]()
    for condition, result in zip(curve.conditions(), results, strict=True):
        for label in results[0].labels:
            squares, nees, _ = result.select(label)
            numbers = {"rmse": interval(squares, root_mean), "nees": interval(nees, mean)}
            if condition.bounded:
                numbers["rmse_over_bound"] = interval(squares, ratio_of_roots, result.best)
            _add_rows(suite, condition, result, label, numbers)
            lines.setdefault(label, []).append(numbers["rmse"])
        if condition.bounded:
            best = interval(result.best, root_mean)
            _add_rows(suite, condition, result, BOUND, {"rmse": best})
            lines.setdefault(BOUND, []).append(best)
    if (figures := import_figures()) is None:
        return
    series = {label: _split_line(values, 1e3) for label, values in lines.items()}
    unit = "RMSE of the sideslip angle / mrad"
    figure = figures.draw_curves(np.array(curve.values), series, curve.label, unit, curve.log)
    suite.answers.append((curve.question, figure, _describe_range(lines, results)))


def _split_line(line: Sequence[Estimate], scale: float) -> tuple[Array, ...]:
    """Values, lows and highs of a line."""
    return tuple(scale * np.array(line).T)


def _describe_range(
    lines: Mapping[str, Sequence[Estimate]], results: Sequence[ConditionResult]
) -> str:
    """Errors (mrad) from the first point to the last."""
    n = min(len(result.best) for result in results)
    ends = {label: (values[0].value, values[-1].value) for label, values in lines.items()}
    spans = [f"{label} {1e3 * a:.2g} to {1e3 * b:.2g}" for label, (a, b) in ends.items()]
    return f"From left to right, mrad: {', '.join(spans)}; at least {n} drives a point."


def _add_reliability(suite: Suite, results: Sequence[ConditionResult]) -> None:
    """Rows and a figure of the fraction of errors within intervals, where `joint` models all."""
    # Conditions share their seeds, so each seed's share is its mean over them; of conditions with
    # the same drives the first one counts.
    shares = dict[str, list[Estimate]]()
    drives = {
        (condition.env_id, repr(condition.scenario)): condition
        for condition in reversed(CONDITIONS)
    }
    for saturating in (False, True):
        kind = "saturating tyres" if saturating else "linear tyres"
        selected = [
            (condition, item)
            for condition, item in zip(CONDITIONS, results, strict=True)
            if condition.modelled
            and condition.bounded != saturating
            and len(item.best)
            and condition is drives[condition.env_id, repr(condition.scenario)]
        ]
        for label in ("joint", "exact-kf"):
            by_seed = dict[int, list[Array]]()
            for _, item in selected:
                for seed, share in zip(item.seeds, item.select(label)[2], strict=True):
                    by_seed.setdefault(seed, []).append(share)
            inside = np.array([np.mean(item, axis=0) for item in by_seed.values()])
            line = [mean_share(column) for column in inside.T]
            shares[f"{label}, {kind}"] = line
            pairs = zip(LEVELS, line, strict=True)
            numbers = {f"covered_{100.0 * level:.0f}": covered for level, covered in pairs}
            columns = {"scenario": f"all with {kind}", "estimator": label}
            add_rows(suite, numbers, selected[0][0].env_id, n=len(inside), **columns)
    if (figures := import_figures()) is None:
        return
    percent = 100.0 * np.array(LEVELS)
    series: dict[str, Any] = {label: _split_line(line, 1e2) for label, line in shares.items()}
    series["ideal"] = percent
    labels = ("confidence of the interval / %", "errors within it / %")
    at = LEVELS.index(0.9)
    text = "; ".join(f"{label} {100.0 * line[at].value:.0f} %" for label, line in shares.items())
    question = "Do the intervals hold what they promise?"
    text = f"In the interval of 90 % are: {text}. Below the diagonal a filter is too sure."
    suite.answers.append((question, figures.draw_curves(percent, series, *labels), text))


def _make_parts_table(suite: Suite, results: Sequence[ConditionResult]) -> ResultTable:
    """Rows and a table of the filter's error without each of its `PARTS`, over that with all."""
    cells = [[label] for label in WITHOUT]
    for condition, result in zip(PARTS, results, strict=True):
        complete_squares = result.select(next(iter(WITHOUT)))[0]
        for line, label in zip(cells, WITHOUT, strict=True):
            squares = result.select(label)[0]
            error = interval(squares, root_mean)
            ratio = interval(squares, ratio_of_roots, complete_squares)
            _add_rows(suite, condition, result, label, {"rmse": error, "ratio": ratio})
            line.append(f"{1e3 * error.value:.2f} ({ratio.value:.2f})")
    title = "What each part of joint saves: RMSE / mrad, and over the complete one's "
    note = (
        "complete: accelerometer, both stiffnesses, friction, biases of gyro and accelerometer, a "
        "force and a moment. Below 1 the part costs more than it saves there."
    )
    header = ("filter", *(condition.name for condition in PARTS))
    return ResultTable(f"{title}({len(results[0].best)} seeds)", header, cells, note)


SEEDS, QUICK_SEEDS = 256, 8
NAME = "unknown"
_COVERED = (0.5, 0.8, 0.95)


def run(seeds: int = SEEDS, jobs: int | None = None, console: Console | None = None) -> Suite:
    """Run all conditions; curves and parts on the first quarter of many seeds.

    Args:
        seeds: Number of seeds.
        jobs: Processes, None for all processors.
        console: Where progress is shown.

    Returns:
        Suite.
    """
    few = min(seeds, max(seeds // 4, QUICK_SEEDS))
    results = measure_all(CONDITIONS, seeds, NAME, jobs, console)
    curve_conditions = [condition for curve in CURVES for condition in curve.conditions()]
    points = measure_all(curve_conditions, few, f"{NAME}: curves", jobs, console)
    parts = measure_all(PARTS, few, f"{NAME}: parts", jobs, console)
    suite = Suite(
        NAME,
        "What does it cost not to know the tyres?",
        'Root mean square error of the sideslip angle from 2 s on (of "from the change on" '
        "from 5 s), over the bound that knows the tyres: the optimal filter of the true linear "
        "car with its true disturbances, which knows when tyres change, but not how "
        "strong a gust is. joint and exact-kf know the nominal car "
        "and the data sheet's noise. NEES: the mean square of joint's error over its own "
        "deviation, 1 where that is honest. Where tyres saturate there is no such bound; the ratio "
        "is to exact-kf alone. Intervals are 95 % over seeds.",
    )
    ratios, against, lines = dict[str, dict[str, Estimate]](), dict[str, Estimate](), []
    for condition, item in zip(CONDITIONS, results, strict=True):
        (joint_squares, nees, inside), labels = item.select("joint"), item.labels
        exact_squares = item.select("exact-kf")[0]
        variances = item.variances[:, labels.index("joint")]
        saved, honest = interval(joint_squares, ratio_of_roots, exact_squares), interval(nees, mean)
        against[condition.name], known = saved, None
        covered = inside.mean(axis=0)
        numbers = {"rmse_over_exact_kf": saved, "nees": honest}
        numbers |= {"covered_95": Estimate(float(covered[-1]))}
        if condition.bounded:
            known = numbers["rmse_over_bound"] = interval(joint_squares, ratio_of_roots, item.best)
            best = interval(exact_squares, ratio_of_roots, item.best)
            ratios[condition.name] = {"joint": known, "exact-kf": best}
        theory = numbers["rmse_over_own"] = interval(joint_squares, ratio_of_roots, variances)
        _add_rows(suite, condition, item, "joint", numbers)
        lines.append([
            condition.name, str(len(nees)), str(item.left_out), _format_ratio(known),
            _format_ratio(saved),
            f"{honest.value:.2f}", f"{theory.value:.2f}",
            *(f"{100.0 * covered[LEVELS.index(level)]:.0f}" for level in _COVERED),
        ])  # fmt: skip
    head = ("condition", "n", "left out", "over the bound", "over exact-kf", "NEES", "over its own")
    suite.tables = [
        ResultTable(
            "joint, which assumes nominal tyres",
            (*head, *(f"in {100.0 * item:.0f} %" for item in _COVERED)),
            lines,
            "left out: episodes that end early, in which tyres that saturate let the car "
            "spin. over its own: error over the deviation that joint gives, where NEES is 1 the "
            "limit of filters that do not know the tyres. in 50 %: share of the errors within the "
            "interval of that confidence.",
        ),
        _make_parts_table(suite, parts),
        *_make_race_table(suite, max(few // 8, 2), jobs, console),
    ]
    suite.verdict = _compose_verdict(ratios, against)
    _draw_figures(suite, ratios)
    _add_reliability(suite, results)
    rest = iter(points)
    for curve in CURVES:
        _add_curve(suite, curve, [next(rest) for _ in curve.values])
    return suite


def _make_race_table(
    suite: Suite, seeds: int, jobs: int | None, console: Console | None
) -> list[ResultTable]:
    """Rows and a table of joint beside FilterPy's filter; none where FilterPy is not installed."""
    if find_spec("filterpy") is None:
        return []
    cases = list(product(DELAYS.values(), range(seeds)))
    results = run_cases(_compare_filters, cases, f"{NAME}: FilterPy", jobs, console)
    errors = np.reshape(results, (-1, seeds, 3, 2))
    cells = []
    for name, values in zip(DELAYS, errors, strict=True):
        for i, label in enumerate(("joint", "FilterPy")):
            error = interval(values[:, i, 0], ratio_of_roots, values[:, 2, 0])
            us = Estimate(float(np.median(values[:, i, 1])))
            numbers = {"rmse_over_bound": error, "us_per_tick": us}
            add_rows(suite, numbers, CAMERA, scenario=name, estimator=label, n=seeds)
            cells.append([name, label, _format_ratio(error), f"{us.value:.3g}"])
    head = ("camera", "filter", "over the bound", "CPU us a tick")
    text = "The same eight states; FilterPy's takes a frame as it arrives. "
    text += "One core, in one process."
    return [ResultTable("Beside FilterPy's extended Kalman filter", head, cells, text)]


def _format_ratio(ratio: Estimate | None) -> str:
    return ratio.inline() if ratio else ""


def _compose_verdict(
    ratios: Mapping[str, Mapping[str, Estimate]], against: Mapping[str, Estimate]
) -> str:
    joint = [item["joint"].value for item in ratios.values()]
    exact = [item["exact-kf"].value for item in ratios.values()]
    worst = max(ratios, key=lambda name: ratios[name]["joint"].value)
    names = (f"from the change on, {item}" for item in ("four members", "one filter"))
    four, one = (against[name].value for name in names)
    return format_verdict(
        "A filter believes in the tyres of a data sheet; a real car's are up to 40 % off.",
        f"joint, which estimates them, has {min(joint):.2f} to {max(joint):.2f} times the least "
        f"error (worst: {worst}).",
        f"exact-kf, which believes in the data sheet, {min(exact):.1f} to {max(exact):.1f}.",
        f"Why: after a change of tyres a bank of four has {four / one:.2f} of one filter's error.",
        "Not covered: recorded cars, whose noise and forces are not known: `sideslip replay`.",
    )


def _draw_figures(suite: Suite, ratios: Mapping[str, Mapping[str, Estimate]]) -> None:
    """One picture; nothing where plotly is not installed."""
    if (figures := import_figures()) is None:
        return
    label = "error / that of a filter that knows the tyres: less is better"
    groups = {name: dict(numbers) for name, numbers in ratios.items()}
    bars = figures.draw_groups(groups, label, {1.0: "knows the tyres"})
    text = suite.verdict.splitlines()[1]
    suite.answers.append(("What does it cost not to know the tyres?", bars, text))


DELAYS = {"camera at once": 0.0, "camera 30 ms late": 0.03}
STATES = 8  # beta, gamma, psi, y_l, F_d, N_d, and both axles' factors


class _FilterPyEkf:
    """FilterPy's filter `ekf` of a car with unknown tyres at a speed (m/s), ticks of dt (s)."""

    def __init__(self, vehicle: Vehicle, speed: float, dt: float) -> None:
        self.car, self.V, self.dt = vehicle, speed, dt
        from filterpy.kalman import ExtendedKalmanFilter  # an extra that few have

        self.ekf: Any = ExtendedKalmanFilter(dim_x=STATES, dim_z=1)
        force, moment, time_constant = DISTURBANCE.values()
        self.ekf.x = np.array([0.0] * 6 + [1.0, 1.0])
        self.ekf.P = np.diag(np.square([0.0, 0.0, 0.0, 0.0, force, moment, 0.23, 0.23]))
        self.decay = np.exp(-dt / time_constant)
        noise_gain = (1.0 - self.decay**2) * np.square([force, moment])
        self.ekf.Q = np.diag([0.0] * 4 + [*noise_gain] + [0.0, 0.0])
        self.ekf.predict_x = self._predict
        self.rows = np.eye(STATES)
        self.noise = [NOISE[f"{name}_noise"] ** 2 for name in ("gyro", "psi", "y_l")]

    def _compute_slopes(self, steer: float) -> tuple[Array, Array]:
        """dx and its Jacobian, without the decay of the disturbances."""
        car, V, (beta, gamma, psi, _, force, moment, front, rear) = self.car, self.V, self.ekf.x
        C_f, C_r = 2.0 * car.front_stiffness, 2.0 * car.rear_stiffness
        l_f, l_r, m, inertia = car.front_arm, car.rear_arm, car.mass, car.yaw_inertia
        at_front, at_rear = steer - beta - l_f / V * gamma, -beta + l_r / V * gamma
        F_f, F_r = C_f * front * at_front, C_r * rear * at_rear
        dx, A = np.zeros(STATES), np.zeros((STATES, STATES))
        dx[0] = (F_f + F_r + force) / (m * V) - gamma
        dx[1] = (l_f * F_f - l_r * F_r + moment) / inertia
        dx[2], dx[3] = gamma, V * (psi + beta) + car.preview * gamma
        by_beta, by_gamma = C_f * front + C_r * rear, l_f * C_f * front - l_r * C_r * rear
        A[0, :2] = -by_beta / (m * V), -1.0 - by_gamma / (m * V * V)
        turn = l_f * l_f * C_f * front + l_r * l_r * C_r * rear
        A[1, :2] = -by_gamma / inertia, -turn / (inertia * V)
        A[0, 4], A[1, 5] = 1.0 / (m * V), 1.0 / inertia
        A[0, 6:], A[1, 6:] = (
            np.array([C_f * at_front, C_r * at_rear]) / (m * V),
            np.array([l_f * C_f * at_front, -l_r * C_r * at_rear]) / inertia,
        )
        A[2, 1], A[3, :3] = 1.0, (V, car.preview, V)
        return dx, A

    def _predict(self, u: float) -> None:
        dt = self.dt
        dx, A = self._compute_slopes(u)
        self.ekf.F = np.eye(STATES) + dt * A + 0.5 * dt * dt * A @ A
        self.ekf.x = self.ekf.x + dt * dx + 0.5 * dt * dt * A @ dx
        self.ekf.F[4, 4] = self.ekf.F[5, 5] = self.decay
        self.ekf.x[4:6] *= self.decay

    def _update(self, state: int, value: float, r: float) -> None:
        row = self.rows[state : state + 1]
        self.ekf.update(np.array([value]), lambda x: row, lambda x: row @ x, R=r)

    def run(self, log: Log) -> Array:
        """Return beta (rad) at every row."""
        record, slips, came = log.record, np.empty(len(log.record.fast)), 0
        for k, row in enumerate(record.fast):
            if k > 0:
                self.ekf.predict(row[FAST.steer])
            self._update(1, row[FAST.gyro], self.noise[0])
            now = record.first + k
            while came < len(record.packets) and record.packets[came, PACKET.arrived] <= now:
                psi, y_l = record.packets[came, PACKET.value : PACKET.value + 2]
                self._update(2, psi, self.noise[1])
                self._update(3, y_l, self.noise[2])
                came += 1
            slips[k] = self.ekf.x[0]
        return slips


def _compare_filters(case: tuple[float, int]) -> Array:
    """Compare mean squared error of beta and CPU time per tick (us): joint, FilterPy's, the bound.

    case: The camera's delay (s) and a seed. Shape (3, 2), without a time of the bound.
    """
    delay, seed = case
    env: Any = gym.make(CAMERA, scenario=LINEAR | MIX | {"camera_delays": (delay,)})
    log, std = run_with_bound(env, seed)
    facts = make_filter_arguments(env.unwrapped)
    joint = call_quietly(make_estimator, "joint", **facts)
    joint.run(log)  # compiled, and its memory warm
    rival = _FilterPyEkf(facts["vehicle"], facts["speed"], facts["dt"])
    settled, results = log.time >= SETTLED - 1e-9, []
    runs: list[Callable[[], Array]] = [lambda: joint.run(log)["beta"], lambda: rival.run(log)]
    for run in runs:
        start = time.process_time()
        beta = run()
        us = 1e6 * (time.process_time() - start) / len(beta)
        results.append([np.mean((beta - log.truth["beta"])[settled] ** 2), us])
    return np.array([*results, [np.mean(std[settled] ** 2), np.nan]])
