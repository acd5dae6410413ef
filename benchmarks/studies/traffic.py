"""The suite `highway`: does stability control save a late driver's swerve among other vehicles?

`sideslip/Highway-v0` on a wet road, the same seeds for everybody; and highway-env's own
`lane-keeping-v0`, driven by `lane-keeping` on our filters and on highway-env's observation.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...agents import make_agent
from ...agents.rollout import iterate_steps
from ...envs.record import Array
from ...envs.task import FAILURES
from ...estimators.wrappers.estimate import EstimateObservation
from ..control.entries import REFERENCE_FILTER, Entry
from ..control.tasks import ORACLES, STATE, ControlTask
from ..harness.drives import call_quietly
from ..harness.results import Column, Line, ResultTable, Suite
from ..harness.stats import Estimate, interval, ratio_of_means, root_mean, share
from ..report.study import Request, Study, format_percent, format_verdict

ID = "sideslip/Highway-v0"
_TASK = ControlTask("", ID, "passenger-car", "lagged", "wet-evasion")
ORACLE = ORACLES[STATE][0]
_READS = {"none": "", ORACLE: ""}
CONTROLLERS = ("none", "two-dof", "lqr", "nmpc", ORACLE)
_SEEDS, _DRIVES = (64, 16), (4, 1)  # of a usual and of a quick run
_CHUNK = 8  # seeds a process
FIRST_SEED = 2**29  # far from other seeds
_ENDS = ("spin", "collision", "departure")

KEEPING = "lane-keeping-v0"
_RETURNED, _NEWEST = "its observation, as step returns it", "its observation, after the step"
READERS = ("multirate-residual-kf", "exact-kf", _RETURNED, _NEWEST)


def _simulate_swerve(case: tuple[str, Sequence[int]]) -> list[list[float]]:
    """Run a controller on some seeds: cost, failure and largest slip (rad) of each."""
    controller, seeds = case
    env, agent = Entry(controller, _READS.get(controller, REFERENCE_FILTER)).make(_TASK)
    rows = []
    for seed in seeds:
        steps = list(iterate_steps(env, agent, FIRST_SEED + seed))
        slip = max(abs(step.info["beta"]) for step in steps)
        rows.append([-sum(step.reward for step in steps), steps[-1].info["failure"], slip])
    return rows


def _keep_lane(case: tuple[str, Sequence[int]]) -> list[Array]:
    """Drive with a reader on a seed: RMS of five numbers in the second half, shape (5,)."""
    from ...envs.highway.env import STATES, KeepingEnv, NativeObservation

    reader, (seed,) = case  # chunks are of one
    base: Any = KeepingEnv()
    env: Any
    if reader in (_RETURNED, _NEWEST):
        env = NativeObservation(base, reader == _RETURNED)
    else:
        env = call_quietly(EstimateObservation, base, reader, outputs=STATES, std=False)
    agent = make_agent("lane-keeping", env, moment=False)
    names = [entry.name for entry in env.get_wrapper_attr("layout")]
    columns = [names.index(f"{name}_hat") for name in STATES]
    rows = []  # errors of slip, yaw rate, heading, preview offset (rad, rad/s, m); offset (m)
    for step in iterate_steps(env, agent, seed):
        rows.append([*(step.obs[columns] - base.truth), base.motion.y])
    return [root_mean(np.square(rows[len(rows) // 2 :]), axis=0)]


Results = tuple[Mapping[str, Array], Mapping[str, Array]]  # by controller, and by reader


def _measure(request: Request) -> Results:
    seeds, drives = _SEEDS[request.quick], _DRIVES[request.quick]
    swerves = request.run_seeds(_simulate_swerve, CONTROLLERS, seeds, _CHUNK, "highway")
    lanes = request.run_seeds(_keep_lane, READERS, drives, 1, KEEPING)
    by_controller = dict(zip(CONTROLLERS, map(np.array, swerves), strict=True))
    return by_controller, dict(zip(READERS, map(np.array, lanes), strict=True))


def _compute_end_rate(numbers: Array, cause: str) -> Estimate:
    """Fraction of episodes that ended by a failure, "none" for success."""
    return share(numbers[:, 1] == FAILURES.index(cause))


def _compose_verdict(results: Results) -> str:
    swerves, lanes = results
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


def _add_tables(suite: Suite, results: Results) -> None:
    records, (swerves, lanes) = list[Line](), results
    free = swerves["none"]
    for controller, numbers in swerves.items():
        record = {
            "controller": controller,
            "estimator": _READS.get(controller, REFERENCE_FILTER),
            "success_rate": _compute_end_rate(numbers, "none"),
            "ratio": interval(numbers[:, 0], ratio_of_means, free[:, 0]),
            "peak_slip": interval(numbers[:, 2]),
        }
        rates = {f"{cause}_rate": _compute_end_rate(numbers, cause) for cause in _ENDS}
        records.append(record | rates)
    suite.add_rows(records, ID, scenario=_TASK.scenario, n=len(free))
    note = (
        f"The same {len(free)} seeds for all; Wilson's intervals; costs are means with failures "
        "charged to the end, paired."
    )
    title = "An evasive lane change on a wet road"
    suite.tables.append(ResultTable(title, _SWERVE_COLUMNS, records, note))
    records = []
    for reader, numbers in lanes.items():
        slip, *errors, offset = map(interval, numbers.T)
        record = {"estimator": reader, "rmse": slip, "offset": offset}
        records.append(record | dict(zip(("rate", "heading", "y_l"), errors, strict=True)))
    suite.add_rows(records, controller="lane-keeping", scenario=KEEPING, n=len(lanes[_NEWEST]))
    note = "RMS errors of what the controller reads, and where the car was, from half time on."
    suite.tables.append(ResultTable("highway-env's lane keeping", _LANE_COLUMNS, records, note))


_SWERVE_COLUMNS = (
    "controller",
    Column("success_rate", "success / %", 100.0, ".1f"),
    *(Column(f"{cause}_rate", f"{cause} / %", 100.0, ".1f", interval=False) for cause in _ENDS),
    Column("ratio", "cost / none's / %", 100.0, ".0f"),
    Column("peak_slip", "peak slip / deg", 180.0 / np.pi, ".2f", interval=False),
)
_LANE_COLUMNS = (
    Column("estimator", "reads"),
    Column("rmse", "slip / mrad", 1e3, ".1f", interval=False),
    Column("rate", "yaw rate / (mrad/s)", 1e3, ".1f", interval=False),
    Column("heading", "heading / mrad", 1e3, ".1f", interval=False),
    Column("y_l", "y_l / cm", 100.0, ".1f", interval=False),
    Column("offset", "off the centre / m", form=".2f"),
)
STUDY = Study(
    "highway", "Swerving among other vehicles, on highway-env's roads",
    "A vehicle ahead brakes hard on a wet road (friction 0.4 to 0.7), and a startled driver "
    "swerves around it and back, late. The yaw moment is the controller's; nobody but the oracle "
    "knows state, tyres and friction. Others are highway-env's IDM vehicles.\n\n"
    "highway-env's own lane keeping: our record (gyro, camera 30 ms late) built from its car, our "
    "filters and `lane-keeping` on it, beside the noisy state that highway-env observes itself.",
    _SEEDS,
    _measure, _add_tables, _compose_verdict,
    needs=("highway_env", 'Not driven: it needs highway-env, pip install "sideslip[highway]".'),
)  # fmt: skip
