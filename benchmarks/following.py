"""Question: what do steering and yaw moment do together? dakf-stability's bandwidth K, and lanes
held on curved roads from camera and gyro, the aim of uneven-delay."""

from collections.abc import Sequence
from functools import partial
from itertools import islice, product
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from .. import __version__
from ..agents import make_agent
from ..agents.controllers.model_following import feedback_gains
from ..agents.rollout import steps_of
from ..envs.record import Array
from ..envs.scenarios.manoeuvres import scenario_from
from ..envs.ticks import TICK
from ..envs.vehicle.dynamics import Motion
from ..envs.vehicle.linear import LinearModel, bicycle
from ..estimators.vector.estimate import EstimateObservation
from .harness.drives import quietly
from .harness.parallel import run_cases
from .harness.results import Row, Suite, Table
from .harness.stats import Estimate, interval, ratio_of_means, share
from .harness.verdict import leader, verdict
from .papers.ledger.tracking import drive, tracking

BANDWIDTHS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # rad/s, K_beta = K_gamma
SEEDS, QUICK_SEEDS = 10, 2
STEP = "dakf-fig7"
ROAD, ROAD_ID = "curved-road", "sideslip/YawVisionUneven-v0"
CARS, QUICK_CARS = 200, 20
KEEPERS = (
    ("none", "uneven-delay-kf", None),
    ("steering alone", "uneven-delay-kf", False),
    ("both", "uneven-delay-kf", True),
    ("steering alone", "multirate-residual-kf", False),
    ("both", "multirate-residual-kf", True),
    ("steering alone", "exact-kf", False),
    ("both", "exact-kf", True),
)
_TEXT = """\
dakf-stability V.D has the bandwidth K limited by actuators and filter: its step by wire \
(Fig. 7) with dakf in the loop, from K = 1 to 100 rad/s. The radius is that of the sampled loop of \
the true car with its lags, without the filter: beyond 1 it is unstable.

Lane keeping: bends of drawn curvature, 1 / 100 m to 1 / 33 m, a lane of 3.5 m, camera and gyro \
with uneven delay; nobody steers but the controller."""
_STATES = ("beta", "gamma", "psi", "y_l")


def loop_radius(scenario: str | dict[str, Any], bandwidth: float) -> float:
    """Spectral radius of dakf-stability's loop as sampled every millisecond, without a filter.

    The true car with its lags, the PI (31) designed for the nominal one and summed by forward
    Euler: beyond 1 the loop is unstable.
    """
    made = scenario_from(scenario)
    env: Any = gym.make("sideslip/AfsYawFusion-v0", scenario=made).unwrapped
    env.reset(seed=0)
    car, speed = env.vehicle, made.range("speed")[0]
    plane = bicycle(car, speed)
    lags = np.array([car.steering_lag, car.motor_lag]) * made.lags
    slow = lags > 0.0
    A, B = np.zeros((4, 4)), np.zeros((4, 2))
    A[:2, :2] = plane.A
    for i in range(2):
        if slow[i]:
            A[:2, 2 + i], A[2 + i, 2 + i], B[2 + i, i] = plane.B[:, i], -1 / lags[i], 1 / lags[i]
        else:  # acts at once: its state is not there
            B[:2, i], A[2 + i, 2 + i] = plane.B[:, i], -1.0 / TICK
    G, H = LinearModel(A, B, np.eye(4), (), (), ()).discrete(TICK)
    P, I = feedback_gains(env.nominal, speed, (bandwidth, bandwidth))  # noqa: E741
    fed = H @ P, -TICK * I, np.zeros((2, 2))
    loop = np.block([[G - np.hstack([fed[0], np.zeros((4, 2))]), H], [fed[1], fed[2], np.eye(2)]])
    return float(np.abs(np.linalg.eigvals(loop)).max())


def follow(case: tuple[float, int]) -> Array:
    """(rms_beta, rms_gamma, saturated, failed) of an episode of STEP with dakf in the loop.

    case: the bandwidth (0: no control) and the seed.
    """
    K, seed = case
    options: dict[str, Any] = {"bandwidth": (K, K)} if K > 0.0 else {"agent": "none"}
    found = tracking(drive(seed, STEP, **options))
    return np.array([found.rms_beta, found.rms_gamma, found.saturated, found.failed], float)


def keep_lane(keeper: int, cars: int) -> Array:
    """(cars, 3): largest offset from the lane's centre in m, RMS slip in rad, left the road."""
    _, estimator, moment = KEEPERS[keeper]
    env: Any = gym.make_vec(ROAD_ID, num_envs=cars, scenario=ROAD, steering=True)
    env = quietly(EstimateObservation, env, estimator, outputs=_STATES, std=False)
    options = {} if moment is None else {"moment": moment}
    agent = make_agent("none" if moment is None else "lane-keeping", env, **options)
    base = env.unwrapped
    most, squares, steps, left = np.zeros((4, cars))
    y = Motion._fields.index("y")
    for step in islice(steps_of(env, agent, 0), 1, None):
        on = step.running
        np.maximum(most, np.abs(base.motion[:, y]), out=most, where=on)
        squares += on * step.info["beta"] ** 2
        steps += on
        left[on & step.terminated] = 1.0
    return np.stack([most, np.sqrt(squares / steps), left], axis=1)


def run(
    seeds: int = SEEDS, cars: int = CARS, jobs: int | None = None, console: Console | None = None
) -> Suite:
    """Both questions; seeds of the step, cars on the road."""
    suite = Suite("following", "What steering and yaw moment do together", _TEXT)
    cases = list(product((0.0, *BANDWIDTHS), range(seeds)))
    found = np.array(run_cases(follow, cases, "bandwidth", jobs, console))
    found = found.reshape(len(BANDWIDTHS) + 1, seeds, -1)
    _bandwidths(suite, found)
    keep = partial(keep_lane, cars=cars)
    lanes = run_cases(keep, range(len(KEEPERS)), "lanes", jobs, console)
    _lanes(suite, lanes)
    suite.verdict = answer(found, lanes)
    return suite


def answer(found: Array, lanes: Sequence[Array]) -> str:
    """The verdict. found: as `_bandwidths` has it; lanes: what `keep_lane` finds, of `KEEPERS`."""
    over = (found[1:, :, :2].mean(axis=1) / found[0, :, :2].mean(axis=0)).mean(axis=1)
    sure = [i for i in range(len(BANDWIDTHS)) if not found[1 + i, :, 3].any()]
    best = min(sure, key=over.__getitem__, default=None)
    follows = (
        "Following: every bandwidth has runs that fail."
        if best is None
        else f"Following: bandwidth K = {BANDWIDTHS[best]:.0f} rad/s errs least, "
        f"{100.0 * over[best]:.0f} % of no control's."
    )
    lost = [f"{K:.0f}" for i, K in enumerate(BANDWIDTHS) if i not in sure]
    offset = {
        _keeper(i).replace(" alone", ""): each[:, 0]
        for i, each in enumerate(lanes)
        if KEEPERS[i][2] is not None
    }
    first, *rest = sorted(offset, key=lambda name: offset[name].mean())
    ratio = {name: interval(offset[first], ratio_of_means, offset[name]) for name in rest}
    reads = first.partition(" on ")[2]
    both, alone = (offset[f"{what} on {reads}"].mean() for what in ("both", "steering"))
    change = f"{100.0 * (both / alone - 1.0):+.0f} %"
    return verdict(
        "Steering and the motors' yaw moment, by one controller; bandwidth: how fast it corrects.",
        follows + (f" Runs fail at {', '.join(lost)}." if lost and sure else ""),
        f"Lanes: {leader(first, ratio, 'stray')}.",
        f"Why: yaw moment beside steering changes the {offset[first].mean():.2f} m by {change}; "
        f"nobody steering: {lanes[0][:, 0].mean():.1f} m.",
        "Not covered: sharper bends, faster cars, and drivers who steer themselves.",
    )


def _keeper(i: int) -> str:
    what, estimator, _ = KEEPERS[i]
    return f"{what} on {estimator}" if what != "none" else what


_COLUMNS = {  # what `follow` gives, and what the figure calls it
    "error of beta / without control": "ratio",
    "error of the yaw rate / without control": "ratio",
    "share of time at the motors' limit": "saturation",
    "share of runs that fail": "share",
}


def _bandwidths(suite: Suite, found: Array) -> None:
    """found: (none and every bandwidth, seeds, numbers of `follow`)."""
    none, seeds = found[0].mean(axis=0), found.shape[1]
    shares = found[1:] / np.where([True, True, False, False], none, 1.0)
    numbers = [[*map(interval, at_K.T[:-1]), share(at_K.T[-1])] for at_K in shares]
    radius = np.array([loop_radius(STEP, K) for K in BANDWIDTHS])
    cells = []
    for K, spread, r in zip(BANDWIDTHS, numbers, radius.tolist(), strict=True):
        cells.append([f"{K:.0f}", *(f"{each.value:.3f}" for each in spread), f"{r:.5f}"])
        scenario = f"{STEP}, K = {K:.0f} rad/s"
        for metric, each in zip(_COLUMNS.values(), spread, strict=True):
            suite.rows.append(_row(scenario, metric, each, seeds))
        suite.rows.append(_row(scenario, "spectral_radius", Estimate(r, r, r), 1))
    header = ("K / (rad/s)", "beta", "yaw rate", "saturated", "failed", "radius")
    note = "Errors over those without control; shares of time and of runs."
    suite.tables.append(Table("The bandwidth K", header, cells, note, keyed=False))
    try:
        from .report.figures import curves
    except ModuleNotFoundError:
        return
    columns = np.array(numbers).transpose(1, 2, 0)  # (column, value low high, K)
    lines = {name: tuple(column) for name, column in zip(_COLUMNS, columns, strict=True)}
    lines["spectral radius of the loop"] = (radius, radius, radius)
    figure = curves(np.array(BANDWIDTHS), lines, "K / (rad/s)", "ratio or share", "x")
    caption = "Tracking, saturation and stability against the bandwidth; whiskers 95 % over seeds."
    suite.figures.append(("dakf-stability V.D: the bandwidth K", figure, caption))


def _lanes(suite: Suite, lanes: list[Array]) -> None:
    cells = []
    for i, numbers in enumerate(lanes):
        what, estimator, _ = KEEPERS[i]
        most, slip, left = *map(interval, numbers.T[:-1]), share(numbers.T[-1])
        cells.append(
            [_keeper(i), *most.text(), f"{1e3 * slip.value:.1f}", f"{100.0 * left.value:.1f}"]
        )
        for metric, each in (("offset", most), ("rms_slip", slip), ("departure_rate", left)):
            who = {"estimator": estimator, "controller": what}
            suite.rows.append(_row(ROAD, metric, each, len(numbers), **who))
    header = ("controller", "largest offset / m", "95 % interval", "RMS slip / mrad", "left / %")
    note = "The largest offset of the centre of gravity from the lane's centre, mean over cars."
    suite.tables.append(Table("Keeping the lane on curved roads", header, cells, note))


def _row(scenario: str, metric: str, number: Estimate, n: int, **who: str) -> Row:
    who = {"estimator": "dakf", "controller": "model-following"} | who
    common = {"suite": "following", "salt": "fixed", "env_version": __version__}
    return Row.of(metric, number, scenario=scenario, n=n, **who, **common)
