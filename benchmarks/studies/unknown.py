"""The suite `unknown`: what does it cost to know neither tyres nor noise?

`joint` on cars whose front and rear stiffness are drawn from 0.6 to 1.4 of what filters assume,
over the bound that knows them; curves over one quantity each; whether intervals hold what they
promise; and, beside `joint`, FilterPy's extended Kalman filter, written as its users would: eight
states, and a camera's frame is used as it arrives, so that late frames make it another filter.
"""

import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from itertools import product
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from ...envs.record import FAST, PACKET, Array, Log
from ...envs.vehicle.parameters import Vehicle
from ...estimators.design.options import NOISE, FilterOptions
from ...estimators.make import make_estimator
from ..harness.drives import SETTLED, call_quietly, make_filter_arguments
from ..harness.results import Column, Line, ResultTable, Suite
from ..harness.stats import Estimate, interval, mean_share, ratio_of_roots, root_mean
from ..harness.verdict import format_verdict
from ..report.study import Request, Study
from .unknown_conditions import (
    CAMERA,
    CONDITIONS,
    CURVES,
    LEVELS,
    LINEAR,
    MIX,
    PARTS,
    WITHOUT,
    ConditionResult,
    Curve,
    measure_all,
    run_with_bound,
)

BOUND = "the bound"
_SEEDS = 256, 8  # of a usual and of a quick run
_COVERED = (0.5, 0.8, 0.95)


class UnknownResults(NamedTuple):
    """Results of all drives; curves and parts are driven on the first quarter of many seeds."""

    conditions: list[ConditionResult]
    curves: list[list[ConditionResult]]  # of each of `CURVES`, a condition for every value
    parts: list[ConditionResult]
    race: Array  # of `_compare_filters`, shape (DELAYS, seeds, 3, 2), empty without FilterPy


def _measure(request: Request) -> UnknownResults:
    seeds = request.episodes or 0
    few = min(seeds, max(seeds // 4, _SEEDS[1]))
    conditions = measure_all(request, CONDITIONS, seeds, "unknown")
    values = [condition for curve in CURVES for condition in curve.conditions()]
    points = iter(measure_all(request, values, few, "unknown: curves"))
    curves = [[next(points) for _ in curve.values] for curve in CURVES]
    parts, race = measure_all(request, PARTS, few, "unknown: parts"), list[Array]()
    if find_spec("filterpy") is not None:
        cases = list(product(DELAYS.values(), range(max(few // 8, 2))))
        race = request.run_cases(_compare_filters, cases, "unknown: FilterPy")
    return UnknownResults(conditions, curves, parts, np.reshape(race, (len(DELAYS), -1, 3, 2)))


def _compute_ratio(result: ConditionResult, label: str) -> Estimate:
    """Compute a filter's error over the bound."""
    return interval(result.squares[label], ratio_of_roots, result.best)


def _add_rows(suite: Suite, result: ConditionResult, label: str, numbers: Line) -> None:
    where = {"scenario": result.condition.name, "estimator": label}
    suite.add_rows([numbers], result.condition.env_id, n=len(result.seeds), **where)


def _add_tables(suite: Suite, results: UnknownResults) -> None:
    """Add rows and tables: all conditions, parts, FilterPy, coverage and curves."""
    records: list[Line] = []
    for item in results.conditions:
        squares, covered = item.squares["joint"], item.inside["joint"].mean(axis=0)
        record: dict[str, Any] = {
            "rmse_over_exact_kf": interval(squares, ratio_of_roots, item.squares["exact-kf"]),
            "nees": interval(item.nees["joint"]),
            "covered_95": covered[-1],
        }
        if item.condition.bounded:
            record["rmse_over_bound"] = _compute_ratio(item, "joint")
        record["rmse_over_own"] = interval(squares, ratio_of_roots, item.variances["joint"])
        _add_rows(suite, item, "joint", record)
        record |= {"n": len(item.seeds), "left out": item.left_out}
        record |= {str(level): covered[LEVELS.index(level)] for level in _COVERED}
        records.append({"condition": item.condition.name} | record)
    note = (
        "left out: episodes that end early, in which tyres that saturate let the car "
        "spin. over its own: error over the deviation that joint gives, where NEES is 1 the "
        "limit of filters that do not know the tyres. in 50 %: share of the errors within the "
        "interval of that confidence."
    )
    title = "joint, which assumes nominal tyres"
    suite.tables = [ResultTable(title, _COLUMNS, records, note), _make_parts_table(suite, results)]
    _add_race(suite, results.race)
    for label, (line, env_id, n) in _compute_coverage(results.conditions).items():
        estimator, _, kind = label.partition(", ")
        pairs = zip(LEVELS, line, strict=True)
        numbers = {f"covered_{100.0 * level:.0f}": covered for level, covered in pairs}
        where = {"scenario": f"all with {kind}", "estimator": estimator}
        suite.add_rows([numbers], env_id, n=n, **where)
    for item in (item for curve in results.curves for item in curve):
        for label, squares in item.squares.items():
            numbers = {"rmse": interval(squares, root_mean)}
            numbers["nees"] = interval(item.nees[label])
            if item.condition.bounded:
                numbers["rmse_over_bound"] = _compute_ratio(item, label)
            _add_rows(suite, item, label, numbers)
        if item.condition.bounded:
            _add_rows(suite, item, BOUND, {"rmse": interval(item.best, root_mean)})


_COLUMNS = (
    *("condition", "n", "left out"),
    Column("rmse_over_bound", "over the bound", form=".2f"),
    Column("rmse_over_exact_kf", "over exact-kf", form=".2f"),
    Column("nees", "NEES", form=".2f", interval=False),
    Column("rmse_over_own", "over its own", form=".2f", interval=False),
    *(Column(str(x), f"in {100.0 * x:.0f} %", scale=100.0, form=".0f") for x in _COVERED),
)


def _make_parts_table(suite: Suite, results: UnknownResults) -> ResultTable:
    """Rows and a table of the filter's error without each of its `PARTS`, over that with all."""
    lines: dict[str, dict[str, Any]] = {label: {"filter": label} for label in WITHOUT}
    for item in results.parts:
        complete = item.squares[next(iter(WITHOUT))]
        for label, squares in item.squares.items():
            if label not in WITHOUT:
                continue
            error = interval(squares, root_mean)
            ratio = interval(squares, ratio_of_roots, complete)
            _add_rows(suite, item, label, {"rmse": error, "ratio": ratio})
            lines[label][item.condition.name] = (1e3 * error.value, ratio.value)
    title = "What each part of joint saves: RMSE / mrad, and over the complete one's "
    note = (
        "complete: accelerometer, both stiffnesses, friction, biases of gyro and accelerometer, a "
        "force and a moment. Below 1 the part costs more than it saves there."
    )
    names = (item.condition.name for item in results.parts)
    columns = ("filter", *(Column(name, form="{:.2f} ({:.2f})") for name in names))
    title += f"({len(results.parts[0].seeds)} seeds)"
    return ResultTable(title, columns, list(lines.values()), note)


def _add_race(suite: Suite, race: Array) -> None:
    """Add rows and a table of joint beside FilterPy's filter; none where it is not installed."""
    records = [
        {
            "scenario": name,
            "estimator": label,
            "rmse_over_bound": interval(values[:, i, 0], ratio_of_roots, values[:, 2, 0]),
            "us_per_tick": float(np.median(values[:, i, 1])),
        }
        for name, values in zip(DELAYS, race, strict=True)
        for i, label in enumerate(("joint", "FilterPy"))
        if len(values)
    ]
    suite.add_rows(records, CAMERA, n=race.shape[1])
    columns = (
        Column("scenario", "camera"),
        Column("estimator", "filter"),
        Column("rmse_over_bound", "over the bound", form=".2f"),
        Column("us_per_tick", "CPU us a tick", form=".3g"),
    )
    text = "The same eight states; FilterPy's takes a frame as it arrives. "
    text += "One core, in one process."
    if records:
        title = "Beside FilterPy's extended Kalman filter"
        suite.tables.append(ResultTable(title, columns, records, text))


def _compute_coverage(
    results: Sequence[ConditionResult],
) -> dict[str, tuple[list[Estimate], str, int]]:
    """Fractions of errors within `LEVELS`, id of the env and count of seeds, by filter and tyres.

    Of the conditions where `joint` models all. They share their seeds, so each seed's fraction is
    its mean over them; of conditions with the same drives the first one counts.
    """
    coverage, drives = {}, dict[tuple[str, str], ConditionResult]()
    for item in results:
        drives.setdefault((item.condition.env_id, repr(item.condition.scenario)), item)
    first = [item for item in drives.values() if item.condition.modelled and item.seeds]
    for kind, bounded in (("linear tyres", True), ("saturating tyres", False)):
        selected = [item for item in first if item.condition.bounded == bounded]
        for label in ("joint", "exact-kf"):
            by_seed = dict[int, list[Array]]()
            for item in selected:
                for seed, fractions in zip(item.seeds, item.inside[label], strict=True):
                    by_seed.setdefault(seed, []).append(fractions)
            inside = np.array([np.mean(x, axis=0) for x in by_seed.values()])
            line = [mean_share(column) for column in inside.T]
            env_id = selected[0].condition.env_id
            coverage[f"{label}, {kind}"] = line, env_id, len(inside)
    return coverage


def _compose_verdict(results: UnknownResults) -> str:
    ratios = _compute_ratios(results)
    joint = {name: item["joint"].value for name, item in ratios.items()}
    exact = [item["exact-kf"].value for item in ratios.values()]
    smallest, largest = min(joint.values()), max(joint.values())
    squares = {item.condition.name: item.squares for item in results.conditions}
    changed = (squares[f"from the change on, {x}"] for x in ("four members", "one filter"))
    four, one = (float(ratio_of_roots(x["joint"], x["exact-kf"])) for x in changed)
    return format_verdict(
        "A filter believes in the tyres of a data sheet; a real car's are up to 40 % off.",
        f"joint, which estimates them, has {smallest:.2f} to {largest:.2f} times the least "
        f"error (worst: {max(joint, key=lambda name: joint[name])}).",
        f"exact-kf, which believes in the data sheet, {min(exact):.1f} to {max(exact):.1f}.",
        f"Why: after a change of tyres a bank of four has {four / one:.2f} of one filter's error.",
        "Not covered: recorded cars, whose noise and forces are not known: `sideslip replay`.",
    )


def _compute_ratios(results: UnknownResults) -> dict[str, dict[str, Estimate]]:
    """Compute the error over the bound by condition that has one, and filter."""
    return {
        item.condition.name: {label: _compute_ratio(item, label) for label in ("joint", "exact-kf")}
        for item in results.conditions
        if item.condition.bounded
    }


def _add_figures(suite: Suite, results: UnknownResults, draw: ModuleType) -> None:
    label = "error / that of a filter that knows the tyres: less is better"
    bars = draw.draw_groups(_compute_ratios(results), label, {1.0: "knows the tyres"})
    text = suite.verdict.splitlines()[1]
    suite.answers.append(("What does it cost not to know the tyres?", bars, text))
    shares = {name: line for name, (line, *_) in _compute_coverage(results.conditions).items()}
    percent = 100.0 * np.array(LEVELS)
    series: dict[str, Any] = {name: _split_line(line, 1e2) for name, line in shares.items()}
    series["ideal"] = percent
    labels = ("confidence of the interval / %", "errors within it / %")
    at = LEVELS.index(0.9)
    text = "; ".join(f"{name} {100.0 * line[at].value:.0f} %" for name, line in shares.items())
    question = "Do the intervals hold what they promise?"
    text = f"In the interval of 90 % are: {text}. Below the diagonal a filter is too sure."
    suite.answers.append((question, draw.draw_curves(percent, series, *labels), text))
    for curve, items in zip(CURVES, results.curves, strict=True):
        suite.answers.append(_draw_curve(curve, items, draw))


def _draw_curve(
    curve: Curve, results: Sequence[ConditionResult], draw: ModuleType
) -> tuple[str, Any, str]:
    """Question, figure, and errors (mrad) from the first point to the last."""
    lines = dict[str, list[Estimate]]()
    for item in results:
        bound = {BOUND: item.best} if item.condition.bounded else {}
        for label, squares in (item.squares | bound).items():
            lines.setdefault(label, []).append(interval(squares, root_mean))
    series = {label: _split_line(values, 1e3) for label, values in lines.items()}
    unit = "RMSE of the sideslip angle / mrad"
    figure = draw.draw_curves(np.array(curve.values), series, curve.label, unit, curve.log)
    ends = {label: (values[0].value, values[-1].value) for label, values in lines.items()}
    spans = [f"{label} {1e3 * a:.2g} to {1e3 * b:.2g}" for label, (a, b) in ends.items()]
    n = min(len(item.seeds) for item in results)
    text = f"From left to right, mrad: {', '.join(spans)}; at least {n} drives a point."
    return curve.question, figure, text


def _split_line(line: Sequence[Estimate], scale: float) -> tuple[Array, ...]:
    """Values, lows and highs of a line."""
    return tuple(scale * np.array(line).T)


DELAYS = {"camera at once": 0.0, "camera 30 ms late": 0.03}
STATES = 8  # beta, gamma, psi, y_l, F_d, N_d, and both axles' factors


class _FilterPyEkf:
    """FilterPy's filter `ekf` of a car with unknown tyres at a speed (m/s), ticks of dt (s)."""

    def __init__(self, vehicle: Vehicle, speed: float, dt: float) -> None:
        self.car, self.V, self.dt = vehicle, speed, dt
        from filterpy.kalman import ExtendedKalmanFilter  # an extra that few have

        self.ekf: Any = ExtendedKalmanFilter(dim_x=STATES, dim_z=1)
        force, moment = FilterOptions.force_sd, FilterOptions.moment_sd
        time_constant = FilterOptions.disturbance_time
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


STUDY = Study(
    "unknown",
    "What does it cost not to know the tyres?",
    'Root mean square error of the sideslip angle from 2 s on (of "from the change on" '
    "from 5 s), over the bound that knows the tyres: the optimal filter of the true linear "
    "car with its true disturbances, which knows when tyres change, but not how "
    "strong a gust is. joint and exact-kf know the nominal car "
    "and the data sheet's noise. NEES: the mean square of joint's error over its own "
    "deviation, 1 where that is honest. Where tyres saturate there is no such bound; the ratio "
    "is to exact-kf alone. Intervals are 95 % over seeds.",
    _SEEDS,
    _measure,
    _add_tables,
    _compose_verdict,
    _add_figures,
)
