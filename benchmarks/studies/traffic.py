"""The suite `highway`: does stability control save a late driver's swerve among other vehicles?

`sideslip/Highway-v0` on a wet road, the same seeds for everybody; and highway-env's own
`lane-keeping-v0`, driven by `lane-keeping` on our filters and on highway-env's observation.
"""

from collections.abc import Mapping
from importlib.util import find_spec
from itertools import product
from typing import Any

import numpy as np
from rich.console import Console

from ...agents import make_agent
from ...agents.baselines import make_oracle
from ...agents.rollout import iterate_steps
from ...envs.record import Array
from ...envs.task import FAILURES
from ...estimators.wrappers.estimate import EstimateObservation
from ..control.entries import (
    REFERENCE_FILTER,
    ControlEntry,
    make_agent_options,
    make_estimate_options,
)
from ..control.tasks import ORACLES, STATE, ControlTask
from ..harness.drives import call_quietly, make_env
from ..harness.parallel import run_cases, split_seeds
from ..harness.results import ResultTable, Suite
from ..harness.stats import Estimate, interval, ratio_of_means, root_mean, share
from ..harness.verdict import format_percent, format_verdict
from ..report.study import add_rows

_NAME, ID = "highway", "sideslip/Highway-v0"
_TASK = ControlTask("", ID, "passenger-car", "lagged", "wet-evasion")
ORACLE = ORACLES[STATE][0]
_READS = {"none": "", "ppo-yaw-vision": "", ORACLE: ""}
CONTROLLERS = ("none", "ppo-yaw-vision", "two-dof", "lqr", "nmpc", ORACLE)
SEEDS, QUICK_SEEDS, _CHUNK = 64, 16, 8
FIRST_SEED = 2**29
_ENDS = ("spin", "collision", "departure")

KEEPING = "lane-keeping-v0"
_RETURNED, _NEWEST = "its observation, as step returns it", "its observation, after the step"
READERS = ("multirate-residual-kf", "exact-kf", _RETURNED, _NEWEST)
DRIVES, QUICK_DRIVES = 4, 1
_TEXT = """\
A vehicle ahead brakes hard on a wet road (friction 0.4 to 0.7), and a startled driver swerves \
around it and back, late. The yaw moment is the controller's; nobody but the oracle knows state, \
tyres and friction. Others are highway-env's IDM vehicles.

highway-env's own lane keeping: our record (gyro, camera 30 ms late) built from its car, our \
filters and `lane-keeping` on it, beside the noisy state that highway-env observes itself."""


def _simulate_swerve(case: tuple[str, tuple[int, ...]]) -> Array:
    """Run a controller on some seeds: cost, failure and largest slip (rad), shape (seeds, 3)."""
    controller, seeds = case
    entry = ControlEntry(_TASK, _READS.get(controller, REFERENCE_FILTER), controller)
    if entry.oracle:
        env, agent = make_oracle(entry.oracle, ID, options=entry.best, **entry.env_options)
    else:
        name, options = "", dict[str, Any]()
        if entry.estimator:
            name, options = "exact-kf", make_estimate_options(entry)
        env = make_env(ID, name, options, **entry.env_options)
        agent = make_agent(controller, env, **make_agent_options(entry))
    rows = []
    for seed in seeds:
        steps = list(iterate_steps(env, agent, FIRST_SEED + seed))
        slip = max(abs(step.info["beta"]) for step in steps)
        rows.append([-sum(step.reward for step in steps), steps[-1].info["failure"], slip])
    return np.array(rows)


def _keep_lane(case: tuple[str, int]) -> Array:
    """Drive with a reader and a seed: RMS of five numbers in the second half, shape (5,).

    Errors of slip, yaw rate, heading (rad, rad/s) and the preview point's offset (m); the car's
    offset from the lane's centre (m).
    """
    from ...envs.highway.lane_keeping_adapter import STATES, KeepingEnv, NativeObservation

    reader, seed = case
    base: Any = KeepingEnv()
    env: Any
    if reader in (_RETURNED, _NEWEST):
        env = NativeObservation(base, reader == _RETURNED)
    else:
        env = call_quietly(EstimateObservation, base, reader, outputs=STATES, std=False)
    agent = make_agent("lane-keeping", env, moment=False)
    names = [entry.name for entry in env.get_wrapper_attr("layout")]
    columns = [names.index(f"{name}_hat") for name in STATES]
    rows = []
    for step in iterate_steps(env, agent, seed):
        rows.append([*(step.obs[columns] - base.truth), base.motion.y])
    return root_mean(np.square(rows[len(rows) // 2 :]), axis=0)


def run(
    seeds: int = SEEDS,
    drives: int = DRIVES,
    jobs: int | None = None,
    console: Console | None = None,
) -> Suite:
    """Answer both questions.

    Args:
        seeds: Seeds of the swerve.
        drives: Drives of the lane keeping.
        jobs: Processes, None for all processors.
        console: Where progress is shown.

    Returns:
        Suite; without rows where highway-env is not installed.
    """
    suite = Suite(_NAME, "Swerving among other vehicles, on highway-env's roads", _TEXT)
    if find_spec("highway_env") is None:
        suite.verdict = 'Not driven: it needs highway-env, pip install "sideslip[highway]".'
        return suite
    chunks = split_seeds(seeds, _CHUNK)
    cases, lane_cases = list(product(CONTROLLERS, chunks)), list(product(READERS, range(drives)))
    parts = iter(run_cases(_simulate_swerve, cases, _NAME, jobs, console))
    swerves = {name: np.concatenate([next(parts) for _ in chunks]) for name in CONTROLLERS}
    rows = iter(run_cases(_keep_lane, lane_cases, KEEPING, jobs, console))
    lanes = {reader: np.array([next(rows) for _ in range(drives)]) for reader in READERS}
    _add_swerves(suite, swerves)
    _add_lanes(suite, lanes)
    suite.verdict = _compose_verdict(swerves, lanes)
    return suite


def _compute_end_rate(numbers: Array, cause: str) -> Estimate:
    """Fraction of episodes that ended by a failure, "none" for success."""
    return share(numbers[:, 1] == FAILURES.index(cause))


def _compose_verdict(swerves: Mapping[str, Array], lanes: Mapping[str, Array]) -> str:
    """Compose the verdict from `simulate_swerve` by controller and `keep_lane` by reader."""
    success = {name: _compute_end_rate(numbers, "none") for name, numbers in swerves.items()}
    names = [name for name in success if name not in ("none", ORACLE)]
    rivals = sorted(names, key=lambda name: -success[name].value)
    rates = {cause: 100.0 * _compute_end_rate(swerves["none"], cause).value for cause in _ENDS}
    ends = ", ".join(f"{cause} {rate:.0f} %" for cause, rate in rates.items())
    offset = {reader: float(numbers[:, -1].mean()) for reader, numbers in lanes.items()}
    filter_best = min((offset[r], r) for r in READERS[:2])
    observation_best = min((offset[r], r) for r in READERS[2:])
    return format_verdict(
        "A late driver swerves around a braking vehicle on a wet road; control has the yaw moment.",
        f"Success: {rivals[0]} {format_percent(success[rivals[0]])}, then {rivals[1]} "
        f"{format_percent(success[rivals[1]])}; none {format_percent(success['none'])}.",
        f"Why: without control {ends}; knowing state and car saves "
        f"{format_percent(success[ORACLE])}.",
        f"highway-env's lane keeping: {filter_best[1]} holds {100.0 * filter_best[0]:.0f} cm "
        f"rms, its own observation {100.0 * observation_best[0]:.0f} cm.",
        "Not covered: drivers who brake as well, sharper bends, other vehicles that swerve.",
    )


def _add_swerves(suite: Suite, swerves: Mapping[str, Array]) -> None:
    cells, free = [], swerves["none"]
    for controller, numbers in swerves.items():
        success = _compute_end_rate(numbers, "none")
        cost = interval(numbers[:, 0], ratio_of_means, free[:, 0])
        slip = interval(numbers[:, 2])
        ends = {cause: _compute_end_rate(numbers, cause) for cause in _ENDS}
        rates = (f"{100.0 * rate.value:.1f}" for rate in ends.values())
        texts = (*success.text(1e2, ".1f"), *rates, *cost.text(1e2, ".0f"))
        cells.append([controller, *texts, f"{np.degrees(slip.value):.2f}"])
        metrics = {"success_rate": success, "ratio": cost, "peak_slip": slip}
        metrics |= {f"{cause}_rate": rate for cause, rate in ends.items()}
        columns = {"controller": controller, "estimator": _READS.get(controller, REFERENCE_FILTER)}
        add_rows(suite, metrics, ID, scenario=_TASK.scenario, n=len(numbers), **columns)
    header = ("controller", "success / %", "95 % interval", *(f"{cause} / %" for cause in _ENDS))
    more = ("cost / none's / %", "95 % interval", "peak slip / deg")
    note = (
        f"The same {len(free)} seeds for all; Wilson's intervals; costs are means with failures "
        "charged to the end, paired."
    )
    title = "An evasive lane change on a wet road"
    suite.tables.append(ResultTable(title, (*header, *more), cells, note))


def _add_lanes(suite: Suite, lanes: Mapping[str, Array]) -> None:
    cells = []
    for reader, numbers in lanes.items():
        slip, rate, heading, preview_offset, offset = (interval(column) for column in numbers.T)
        shown = [f"{1e3 * error.value:.1f}" for error in (slip, rate, heading)]
        texts = (f"{100.0 * preview_offset.value:.1f}", *offset.text(1.0, ".2f"))
        cells.append([reader, *shown, *texts])
        columns = {"controller": "lane-keeping", "estimator": reader, "scenario": KEEPING}
        add_rows(suite, {"rmse": slip, "offset": offset}, ID, n=len(numbers), **columns)
    header = ("reads", "slip / mrad", "yaw rate / (mrad/s)", "heading / mrad", "y_l / cm")
    where = ("off the centre / m", "95 % interval")
    note = "RMS errors of what the controller reads, and where the car was, from half time on."
    suite.tables.append(ResultTable("highway-env's lane keeping", (*header, *where), cells, note))
