"""The suite `following`: what steering and yaw moment do together.

dakf-stability's bandwidth K, and lanes held on curved roads from camera and gyro with uneven delay.
"""

from functools import partial
from itertools import islice, product
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from ...agents import make_agent
from ...agents.controllers.yaw_stability import compute_feedback_gains
from ...agents.rollout import iterate_steps
from ...envs.record import Array
from ...envs.scenarios.manoeuvres import make_scenario
from ...envs.ticks import TICK
from ...envs.vehicle.dynamics import Motion
from ...envs.vehicle.linear import LinearModel, make_bicycle_model
from ...estimators.vector.estimate import EstimateObservation
from ..harness.drives import call_quietly
from ..harness.results import Column, ResultTable, Suite
from ..harness.stats import Estimate, interval, ratio_of_means, share
from ..harness.verdict import describe_leader, format_verdict
from ..papers.manoeuvres import measure_tracking, run_episode
from ..report.study import Request, Study

BANDWIDTHS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # rad/s, K_beta = K_gamma
_SEEDS, _CARS = (10, 2), (200, 20)  # of a usual and of a quick run
_STEP = "dakf-fig7"
_ROAD, _ROAD_ID = "curved-road", "sideslip/YawVisionUneven-v0"
LANE_CONTROLLERS = (
    ("none", "uneven-delay-kf", None),
    ("steering alone", "uneven-delay-kf", False),
    ("both", "uneven-delay-kf", True),
    ("steering alone", "multirate-residual-kf", False),
    ("both", "multirate-residual-kf", True),
    ("steering alone", "exact-kf", False),
    ("both", "exact-kf", True),
)
_STATES = ("beta", "gamma", "psi", "y_l")


def _compute_loop_radius(scenario: str | dict[str, object], bandwidth: float) -> float:
    """Compute the spectral radius of dakf-stability's sampled loop: beyond 1 it is unstable."""
    # the true car with its lags, the PI (31) of the nominal one, summed by forward Euler; no filter
    parsed = make_scenario(scenario)
    env: Any = gym.make("sideslip/AfsYawFusion-v0", scenario=parsed).unwrapped
    env.reset(seed=0)
    car, speed = env.vehicle, parsed.range("speed")[0]
    plane = make_bicycle_model(car, speed)
    lags = np.array([car.steering_lag, car.motor_lag]) * parsed.lags
    slow = lags > 0.0
    A, B = np.zeros((4, 4)), np.zeros((4, 2))
    A[:2, :2] = plane.A
    for i in range(2):
        if slow[i]:
            A[:2, 2 + i], A[2 + i, 2 + i], B[2 + i, i] = plane.B[:, i], -1 / lags[i], 1 / lags[i]
        else:  # acts at once: its state is not there
            B[:2, i], A[2 + i, 2 + i] = plane.B[:, i], -1.0 / TICK
    G, H = LinearModel(A, B, np.eye(4), (), (), ()).discretise(TICK)
    P, I = compute_feedback_gains(env.nominal, speed, (bandwidth, bandwidth))  # noqa: E741
    closed = G - np.hstack([H @ P, np.zeros((4, 2))])
    loop = np.block([[closed, H], [-TICK * I, np.zeros((2, 2)), np.eye(2)]])
    return float(np.abs(np.linalg.eigvals(loop)).max())


def _track_reference(case: tuple[float, int]) -> Array:
    """Run the step with dakf in the loop: rms_beta (rad), rms_gamma (rad/s), saturated, failed."""
    K, seed = case  # rad/s, 0 for no control
    options: dict[str, Any] = {"bandwidth": (K, K)} if K > 0.0 else {"agent": "none"}
    numbers = measure_tracking(run_episode(seed, _STEP, **options))
    return np.array([numbers[x] for x in ("rms_beta", "rms_gamma", "saturated", "failed")])


def _keep_lane(index: int, cars: int) -> Array:
    """Drive the road: largest offset from the lane (m), RMS slip (rad), departed; (cars, 3)."""
    _, estimator, moment = LANE_CONTROLLERS[index]
    env: Any = gym.make_vec(_ROAD_ID, num_envs=cars, scenario=_ROAD, steering=True)
    env = call_quietly(EstimateObservation, env, estimator, outputs=_STATES, std=False)
    options = {} if moment is None else {"moment": moment}
    agent = make_agent("none" if moment is None else "lane-keeping", env, **options)
    base = env.unwrapped
    max_offset, squares, steps, departed = np.zeros((4, cars))
    y = Motion._fields.index("y")
    for step in islice(iterate_steps(env, agent, 0), 1, None):
        running = step.running
        np.maximum(max_offset, np.abs(base.motion[:, y]), out=max_offset, where=running)
        squares += running * step.info["beta"] ** 2
        steps += running
        departed[running & step.terminated] = 1.0
    return np.stack([max_offset, np.sqrt(squares / steps), departed], axis=1)


class FollowingResults(NamedTuple):
    """Numbers of both questions."""

    errors: Array  # of `_track_reference`, shape (1 + bandwidths, seeds, 4)
    radius: Array  # spectral radius of the loop, shape (bandwidths,)
    lanes: list[Array]  # of `_keep_lane`, of each of `LANE_CONTROLLERS`


def _measure(request: Request) -> FollowingResults:
    seeds, cars = request.choose(*_SEEDS), request.choose(*_CARS)
    cases = list(product((0.0, *BANDWIDTHS), range(seeds)))
    errors = np.array(request.run_cases(_track_reference, cases, "bandwidth"))
    lane_cases = range(len(LANE_CONTROLLERS))
    lanes = request.run_cases(partial(_keep_lane, cars=cars), lane_cases, "lanes")
    radius = np.array([_compute_loop_radius(_STEP, K) for K in BANDWIDTHS])
    return FollowingResults(errors.reshape(len(BANDWIDTHS) + 1, seeds, -1), radius, lanes)


def _compose_verdict(results: FollowingResults) -> str:
    errors, _, lanes = results
    ratios = (errors[1:, :, :2].mean(axis=1) / errors[0, :, :2].mean(axis=0)).mean(axis=1)
    stable = [i for i in range(len(BANDWIDTHS)) if not errors[1 + i, :, 3].any()]
    best = min(stable, key=ratios.__getitem__, default=None)
    follows = (
        "Following: every bandwidth has runs that fail."
        if best is None
        else f"Following: bandwidth K = {BANDWIDTHS[best]:.0f} rad/s errs least, "
        f"{100.0 * ratios[best]:.0f} % of no control's."
    )
    lost = [f"{K:.0f}" for i, K in enumerate(BANDWIDTHS) if i not in stable]
    offset = {
        _label_controller(i).replace(" alone", ""): numbers[:, 0]
        for i, numbers in enumerate(lanes)
        if LANE_CONTROLLERS[i][2] is not None
    }
    first, *others = sorted(offset, key=lambda name: offset[name].mean())
    ratio = {name: interval(offset[first], ratio_of_means, offset[name]) for name in others}
    reads = first.partition(" on ")[2]
    pair = (f"{actuators} on {reads}" for actuators in ("both", "steering"))
    both, steering_only = (offset[name].mean() for name in pair)
    change = f"{100.0 * (both / steering_only - 1.0):+.0f} %"
    return format_verdict(
        "Steering and the motors' yaw moment, by one controller; bandwidth: how fast it corrects.",
        follows + (f" Runs fail at {', '.join(lost)}." if lost and stable else ""),
        f"Lanes: {describe_leader(first, ratio, 'stray')}.",
        f"Why: yaw moment beside steering changes the {offset[first].mean():.2f} m by {change}; "
        f"nobody steering: {lanes[0][:, 0].mean():.1f} m.",
        "Not covered: sharper bends, faster cars, and drivers who steer themselves.",
    )


def _label_controller(i: int) -> str:
    actuators, estimator, _ = LANE_CONTROLLERS[i]
    return f"{actuators} on {estimator}" if actuators != "none" else actuators


_COLUMNS = {  # what `_track_reference` gives
    "error of beta / without control": "ratio",
    "error of the yaw rate / without control": "ratio",
    "share of time at the motors' limit": "saturation",
    "share of runs that fail": "share",
}


def _compute_spreads(errors: Array) -> list[list[Estimate]]:
    """Compute the numbers of `_COLUMNS` at every bandwidth."""
    shares = errors[1:] / np.where([True, True, False, False], errors[0].mean(axis=0), 1.0)
    return [[*map(interval, at_K.T[:-1]), share(at_K.T[-1])] for at_K in shares]


def _add_tables(suite: Suite, results: FollowingResults) -> None:
    """Add rows and a table of the bandwidths, and those of the lanes."""
    seeds, lines = results.errors.shape[1], []
    spreads = _compute_spreads(results.errors)
    for K, spread, r in zip(BANDWIDTHS, spreads, results.radius.tolist(), strict=True):
        where = {"estimator": "dakf", "controller": "model-following"}
        where["scenario"] = f"{_STEP}, K = {K:.0f} rad/s"
        pairs = zip(_COLUMNS.values(), spread, strict=True)
        suite.add_rows([{metric: number} for metric, number in pairs], **where, n=seeds)
        suite.add_rows([{"spectral_radius": Estimate(r, r, r)}], **where, n=1)
        lines.append([K, *spread, r])
    shares = (Column(name, form=".3f", interval=False) for name in _COLUMNS)
    columns = (Column("K / (rad/s)"), *shares, Column("radius", form=".5f"))
    suite.tables.append(ResultTable("The bandwidth K", columns, lines, keyed=False))
    records = []
    for i, numbers in enumerate(results.lanes):
        actuators, estimator, _ = LANE_CONTROLLERS[i]
        entry = {"label": _label_controller(i), "estimator": estimator, "controller": actuators}
        motion = {"offset": interval(numbers[:, 0]), "rms_slip": interval(numbers[:, 1])}
        records.append({**entry, **motion, "departure_rate": share(numbers[:, 2])})
    suite.add_rows(records, scenario=_ROAD, n=len(results.lanes[0]))
    note = "The largest offset of the centre of gravity from the lane's centre, mean over cars."
    title = "Keeping the lane on curved roads"
    suite.tables.append(ResultTable(title, _LANE_COLUMNS, records, note))


_LANE_COLUMNS = (
    Column("label", "controller"),
    Column("offset", "largest offset / m", form=".3f"),
    Column("rms_slip", "RMS slip / mrad", 1e3, ".1f", interval=False),
    Column("departure_rate", "left / %", 100.0, ".1f", interval=False),
)


def _add_figures(suite: Suite, results: FollowingResults, draw: ModuleType) -> None:
    # (column, value low high, K)
    curves = np.array(_compute_spreads(results.errors)).transpose(1, 2, 0)
    lines = {name: tuple(curve) for name, curve in zip(_COLUMNS, curves, strict=True)}
    lines["spectral radius of the loop"] = (results.radius,) * 3
    figure = draw.draw_curves(np.array(BANDWIDTHS), lines, "K / (rad/s)", "ratio or share", "x")
    caption = "Tracking, saturation and stability against the bandwidth; whiskers 95 % over seeds."
    suite.figures.append(("dakf-stability V.D: the bandwidth K", figure, caption))


STUDY = Study(
    "following",
    "What steering and yaw moment do together",
    "dakf-stability V.D has the bandwidth K limited by actuators and filter: its step by wire "
    "(Fig. 7) with dakf in the loop, from K = 1 to 100 rad/s. The radius is that of the sampled "
    "loop of the true car with its lags, without the filter: beyond 1 it is unstable.\n\n"
    "Lane keeping: bends of drawn curvature, 1 / 100 m to 1 / 33 m, a lane of 3.5 m, camera and "
    "gyro with uneven delay; nobody steers but the controller.",
    _SEEDS,
    _measure,
    _add_tables,
    _compose_verdict,
    _add_figures,
)
