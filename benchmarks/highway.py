"""Question: does stability control save a late driver's swerve on a wet road among other vehicles?

`sideslip/Highway-v0` as it is by default, the same seeds for everybody; and highway-env's own
`lane-keeping-v0`, driven by `lane-keeping` on our filters and on highway-env's observation.
"""

from collections.abc import Mapping
from importlib.util import find_spec
from itertools import product
from typing import Any

import numpy as np
from rich.console import Console

from .. import __version__
from ..agents import make_agent
from ..agents.rollout import steps_of
from ..agents.rungs import make_rung
from ..envs.record import Array
from ..envs.task.failures import FAILURES
from ..estimators.wrappers.estimate import EstimateObservation
from .control.build import agent_options, estimate_options
from .control.cells import REFERENCE_FILTER, Cell
from .control.contests import ORACLES, STATE, Contest
from .harness.drives import make_env, quietly
from .harness.parallel import chunked, run_cases
from .harness.results import Row, Suite, Table
from .harness.stats import Estimate, interval, ratio_of_means, root_mean, share
from .harness.verdict import percent, verdict

NAME, ID = "highway", "sideslip/Highway-v0"
CONTEST = Contest("", ID, "passenger-car", "lagged", "wet-evasion")
ORACLE = ORACLES[STATE][0]
READS = {"none": "", "ppo-yaw-vision": "", ORACLE: ""}
CONTROLLERS = ("none", "ppo-yaw-vision", "two-dof", "lqr", "nmpc", ORACLE)
SEEDS, QUICK_SEEDS, CHUNK = 64, 16, 8
FIRST_SEED = 2**29
ENDS = ("spin", "collision", "departure")

KEEPING = "lane-keeping-v0"
RETURNED, NEWEST = "its observation, as step returns it", "its observation, after the step"
READERS = ("multirate-residual-kf", "exact-kf", RETURNED, NEWEST)
DRIVES, QUICK_DRIVES = 4, 1
_TEXT = """\
A vehicle ahead brakes hard on a wet road (friction 0.4 to 0.7), and a startled driver swerves \
around it and back, late. The yaw moment is the controller's; nobody but the oracle knows state, \
tyres and friction. Others are highway-env's IDM vehicles.

highway-env's own lane keeping: our record (gyro, camera 30 ms late) built from its car, our \
filters and `lane-keeping` on it, beside the noisy state that highway-env observes itself."""


def swerve(case: tuple[str, tuple[int, ...]]) -> Array:
    """(seeds, 3): cost, failure and largest slip in rad of a controller on some seeds."""
    who, seeds = case
    cell = Cell(CONTEST, READS.get(who, REFERENCE_FILTER), who)
    if cell.rung:
        env, agent = make_rung(cell.rung, ID, options=cell.best, **cell.env_options)
    else:
        name, options = "", dict[str, Any]()
        if cell.estimator:
            name, options = "exact-kf", estimate_options(cell)
        env = make_env(ID, name, options, **cell.env_options)
        agent = make_agent(who, env, **agent_options(cell))
    found = []
    for seed in seeds:
        steps = list(steps_of(env, agent, FIRST_SEED + seed))
        slip = max(abs(step.info["beta"]) for step in steps)
        found.append([-sum(step.reward for step in steps), steps[-1].info["failure"], slip])
    return np.array(found)


def keep_lane(case: tuple[str, int]) -> Array:
    """(5,): RMS errors of slip, yaw rate, heading and offset at the preview point, and the RMS
    offset in m from the lane's centre, in the second half of a drive."""
    from ..envs.highway.keeping import STATES, KeepingEnv, OwnObservation

    reader, seed = case
    base: Any = KeepingEnv()
    env: Any
    if reader in (RETURNED, NEWEST):
        env = OwnObservation(base, reader == RETURNED)
    else:
        env = quietly(EstimateObservation, base, reader, outputs=STATES, std=False)
    agent = make_agent("lane-keeping", env, moment=False)
    names = [entry.name for entry in env.get_wrapper_attr("layout")]
    columns = [names.index(f"{name}_hat") for name in STATES]
    rows = []
    for step in steps_of(env, agent, seed):
        error = step.obs[columns] - base.truth
        rows.append([*error, base.motion.y])
    return root_mean(np.square(rows[len(rows) // 2 :]), axis=0)


def run(
    seeds: int = SEEDS,
    drives: int = DRIVES,
    jobs: int | None = None,
    console: Console | None = None,
) -> Suite:
    """Both questions; seeds of the swerve, drives of the lane keeping."""
    suite = Suite(NAME, "Swerving among other vehicles, on highway-env's roads", _TEXT)
    if find_spec("highway_env") is None:
        suite.verdict = 'Not driven: it needs highway-env, pip install "sideslip[highway]".'
        return suite
    cases = list(product(CONTROLLERS, chunked(seeds, CHUNK)))
    parts = run_cases(swerve, cases, NAME, jobs, console)
    swerves = {
        who: np.concatenate(
            [part for (each, _), part in zip(cases, parts, strict=True) if each == who]
        )
        for who in CONTROLLERS
    }
    drives_of = list(product(READERS, range(drives)))
    kept = run_cases(keep_lane, drives_of, KEEPING, jobs, console)
    lanes = {
        reader: np.array(
            [each for (name, _), each in zip(drives_of, kept, strict=True) if name == reader]
        )
        for reader in READERS
    }
    _swerves(suite, swerves)
    _lanes(suite, lanes)
    suite.verdict = answer(swerves, lanes)
    return suite


def ended(numbers: Array, by: str) -> Estimate:
    """The share of episodes that ended by a failure, "none" for success, with Wilson's interval."""
    return share(numbers[:, 1] == FAILURES.index(by))


def answer(swerves: Mapping[str, Array], lanes: Mapping[str, Array]) -> str:
    """The verdict; arguments as `swerve` and `keep_lane` have them, by controller and reader."""
    success = {who: ended(numbers, "none") for who, numbers in swerves.items()}
    rivals = sorted(
        (who for who in success if who not in ("none", ORACLE)), key=lambda who: -success[who].value
    )
    free = swerves["none"]
    ends = ", ".join(f"{by} {100.0 * ended(free, by).value:.0f} %" for by in ENDS)
    offset = {reader: float(numbers[:, -1].mean()) for reader, numbers in lanes.items()}
    ours, theirs = (
        min((offset[r], r) for r in READERS[:2]),
        min((offset[r], r) for r in READERS[2:]),
    )
    return verdict(
        "A late driver swerves around a braking vehicle on a wet road; control has the yaw moment.",
        f"Success: {rivals[0]} {percent(success[rivals[0]])}, then {rivals[1]} "
        f"{percent(success[rivals[1]])}; none {percent(success['none'])}.",
        f"Why: without control {ends}; knowing state and car saves {percent(success[ORACLE])}.",
        f"highway-env's lane keeping: {ours[1]} holds {100.0 * ours[0]:.0f} cm rms, its own "
        f"observation {100.0 * theirs[0]:.0f} cm.",
        "Not covered: drivers who brake as well, sharper bends, other vehicles that swerve.",
    )


def _swerves(suite: Suite, swerves: Mapping[str, Array]) -> None:
    cells, free = [], swerves["none"]
    for who, numbers in swerves.items():
        success = ended(numbers, "none")
        cost = interval(numbers[:, 0], ratio_of_means, free[:, 0])
        slip = interval(numbers[:, 2])
        ends = {by: ended(numbers, by) for by in ENDS}
        cells.append(
            [
                who,
                *success.text(1e2, ".1f"),
                *(f"{100.0 * each.value:.1f}" for each in ends.values()),
                *cost.text(1e2, ".0f"),
                f"{np.degrees(slip.value):.2f}",
            ]
        )
        metrics = {"success_rate": success, "ratio": cost, "peak_slip": slip}
        metrics |= {f"{by}_rate": each for by, each in ends.items()}
        reads = READS.get(who, REFERENCE_FILTER)
        _add(suite, CONTEST.scenario, metrics, len(numbers), controller=who, estimator=reads)
    header = ("controller", "success / %", "95 % interval", *(f"{by} / %" for by in ENDS))
    more = ("cost / none's / %", "95 % interval", "peak slip / deg")
    note = (
        f"The same {len(free)} seeds for all; Wilson's intervals; costs are means with failures "
        "charged to the end, paired."
    )
    suite.tables.append(
        Table("An evasive lane change on a wet road", (*header, *more), cells, note)
    )


def _lanes(suite: Suite, lanes: Mapping[str, Array]) -> None:
    cells = []
    for reader, numbers in lanes.items():
        slip, rate, heading, ahead, offset = (interval(column) for column in numbers.T)
        shown = [f"{1e3 * each.value:.1f}" for each in (slip, rate, heading)]
        cells.append([reader, *shown, f"{100.0 * ahead.value:.1f}", *offset.text(1.0, ".2f")])
        who = {"controller": "lane-keeping", "estimator": reader}
        _add(suite, KEEPING, {"rmse": slip, "offset": offset}, len(numbers), **who)
    header = ("reads", "slip / mrad", "yaw rate / (mrad/s)", "heading / mrad", "y_l / cm")
    where = ("off the centre / m", "95 % interval")
    note = "RMS errors of what the controller reads, and where the car was, from half time on."
    suite.tables.append(Table("highway-env's lane keeping", (*header, *where), cells, note))


def _add(suite: Suite, scenario: str, metrics: Mapping[str, Estimate], n: int, **who: str) -> None:
    common = {"suite": NAME, "salt": "fixed", "env_version": f"{ID} {__version__}"}
    suite.rows += [
        Row.of(metric, number, scenario=scenario, n=n, **who, **common)
        for metric, number in metrics.items()
    ]
