"""Question: what does it cost to know neither tyres nor noise? `joint` on cars whose front and rear
stiffness are drawn from 0.6 to 1.4 of what it was told, over the bound that knows them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console
from scipy.stats import norm

from .. import __version__
from ..agents.rollout import rollout
from ..envs.record import Array
from ..estimators.analysis.bound import bound
from ..estimators.make import make_estimator
from .harness.drives import SETTLED, facts_of, quietly
from .harness.parallel import chunked, run_cases
from .harness.results import Row, Suite, Table
from .harness.stats import Estimate, interval, mean, ratio_of_roots
from .harness.verdict import verdict

SEEDS, QUICK_SEEDS = 256, 8
NAME = "unknown"
_CHUNK = 8
CAMERA, GPS, FUSION = (f"sideslip/Yaw{each}-v0" for each in ("Vision", "Gps", "Fusion"))
KMH = 1.0 / 3.6
STIFF = {"front_stiffness": (0.6, 1.4), "rear_stiffness": (0.6, 1.4)}
LINEAR = {"base": "random-steering", "small_angle": True, "tyres": "linear", "roll": False}
LINEAR |= {"lags": False, "speed": 25.0 * KMH, "hdop_law": "constant"} | STIFF
MIX = {"amplitude": (0.03, 0.08), "amplitude_2": (0.02, 0.05)}
CHANGE = {"tyre_change_time": 5.0, "front_change": (0.7, 1.3), "rear_change": (0.7, 1.3)}
COVERED = (0.5, 0.8, 0.95)


@dataclass(frozen=True)
class Condition:
    """A kind of drive. scenario: over `LINEAR`. options: of `joint`. since: s, from which errors
    count. bounded: whether the bound is one there, where the car is linear and does not change.
    """

    name: str
    env_id: str = CAMERA
    scenario: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    since: float = SETTLED
    bounded: bool = True


BIAS = {"noise": {"gyro_bias": np.pi / 360.0}}
UNEVEN = {"camera_delays": (0.02, 0.015, 0.01, 0.025)}
CONDITIONS = (
    Condition("camera", CAMERA, MIX),
    Condition("GPS", GPS, MIX),
    Condition("camera and GPS", FUSION, MIX),
    Condition("camera, gentle steering", CAMERA),
    Condition("GPS, gentle steering", GPS),
    Condition("camera, 10 km/h", CAMERA, MIX | {"speed": 10.0 * KMH}),
    Condition("camera, 40 km/h, gentle", CAMERA, {"speed": 40.0 * KMH}),
    Condition("camera, gyro 0.5 deg/s off", CAMERA, MIX | BIAS, {"bias_sd": 0.01}),
    Condition("GPS, gyro 0.5 deg/s off", GPS, MIX | BIAS, {"bias_sd": 0.01}),
    Condition("camera 20, 15, 10, 25 ms late", CAMERA, MIX | UNEVEN),
    Condition("GPS out for 5 s", GPS, MIX | {"gps_outage": (3.0, 8.0)}),
    Condition(
        "half the disturbances it was told",
        CAMERA,
        MIX | {"disturbance_force": 25.0, "disturbance_moment": 10.0},
    ),
    Condition(
        "twice the disturbances it was told",
        CAMERA,
        MIX | {"disturbance_force": 100.0, "disturbance_moment": 40.0},
    ),
    Condition(
        "tyres change at 5 s, four members", CAMERA, MIX | CHANGE, {"members": 4}, bounded=False
    ),
    Condition("the same, one filter", CAMERA, MIX | CHANGE, bounded=False),
    Condition(
        "Fiala tyres, friction 0.9",
        CAMERA,
        MIX | {"tyres": "fiala", "friction": 0.9},
        {"inverse_friction_sd": 0.5},
        bounded=False,
    ),
    Condition(
        "slalom, Fiala tyres, friction 0.5",
        CAMERA,
        {"base": "slalom", "tyres": "fiala", "friction": 0.5},
        {"inverse_friction_sd": 0.5},
        bounded=False,
    ),
)


@dataclass
class Measured:
    """Of some seeds: mean squared errors of joint, exact-kf (seeds, 2), of the bound (seeds,), NEES
    of joint (seeds,), and shares of its errors within `COVERED` (seeds, 3). Episodes that ended
    early are left out."""

    squares: Array
    best: Array
    nees: Array
    covered: Array
    left_out: int


def measure(case: tuple[int, tuple[int, ...]]) -> Measured:
    """Drive some seeds of a condition; both filters read the same records."""
    what, seeds = CONDITIONS[case[0]], case[1]
    env: Any = gym.make(what.env_id, scenario=LINEAR | dict(what.scenario), control_period=10)
    base, z = env.unwrapped, norm.ppf(0.5 + 0.5 * np.array(COVERED))
    found = []
    for seed in seeds:
        drive = rollout(env, seed=seed)
        if drive.failed:
            continue
        facts = facts_of(base)
        late = drive.log.time >= what.since - 1e-9
        run = {}
        for name, options in (("joint", what.options), ("exact-kf", {})):
            slow = {"slow": list(drive.log.slow)}
            run[name] = quietly(make_estimator, name, **facts | slow, **options).run(drive.log)
        truth = drive.log.truth["beta"][late]
        errors = [run[name]["beta"][late] - truth for name in run]
        size = np.abs(errors[0]) / run["joint"].std[late, run["joint"].names.index("beta")]
        told = {"force_sd": base.scenario.disturbance_force}
        told |= {"moment_sd": base.scenario.disturbance_moment}
        std = bound(record=drive.log.record, **facts | told | {"vehicle": base.vehicle})[late]
        squares = [float(np.mean(each**2)) for each in errors]
        found.append(
            (*squares, np.mean(std**2), np.mean(size**2), *(np.mean(size < each) for each in z))
        )
    table = np.array(found).reshape(len(found), 4 + len(z))
    return Measured(table[:, :2], table[:, 2], table[:, 3], table[:, 4:], len(seeds) - len(found))


def run(seeds: int = SEEDS, jobs: int | None = None, console: Console | None = None) -> Suite:
    """Every condition on the seeds 0 .. seeds-1."""
    cases = [(i, chunk) for i in range(len(CONDITIONS)) for chunk in chunked(seeds, _CHUNK)]
    results = run_cases(measure, cases, NAME, jobs, console)
    suite = Suite(
        NAME,
        "What does it cost not to know the tyres?",
        "Root mean square error of the sideslip angle from 2 s on, over the bound that knows the "
        "tyres: the optimal filter of the true linear car, told its disturbances. joint and "
        "exact-kf know the nominal car and the data sheet's noise. NEES: the mean square of "
        "joint's error over its own deviation, 1 where that is honest. Where the car is not "
        "linear, or changes, there is no such bound; the ratio is to exact-kf alone. 95 % "
        "bootstrap over seeds.",
    )
    over, against, lines = {}, {}, []
    for i, what in enumerate(CONDITIONS):
        mine = [r for (k, _), r in zip(cases, results, strict=True) if k == i]
        squares, best, nees, covered = (
            np.concatenate([getattr(m, name) for m in mine])
            for name in ("squares", "best", "nees", "covered")
        )
        saved = interval(squares[:, 0], ratio_of_roots, squares[:, 1])
        against[what.name] = saved
        known = interval(squares[:, 0], ratio_of_roots, best) if what.bounded else None
        if known is not None:
            over[what.name] = {
                "joint": known,
                "exact-kf": interval(squares[:, 1], ratio_of_roots, best),
            }
        honest, inside = interval(nees, mean), covered.mean(axis=0)
        lines.append([
            what.name, str(len(best)), str(sum(m.left_out for m in mine)),
            f"{known.value:.2f} [{known.low:.2f}, {known.high:.2f}]" if known else "",
            f"{saved.value:.2f} [{saved.low:.2f}, {saved.high:.2f}]",
            f"{honest.value:.2f}", *(f"{100.0 * each:.0f}" for each in inside),
        ])  # fmt: skip
        common = {
            "suite": NAME,
            "scenario": what.name,
            "n": len(best),
            "salt": "fixed",
            "env_version": f"{what.env_id} {__version__}",
        }
        numbers = {
            "rmse_over_exact_kf": saved,
            "nees": honest,
            "covered_95": Estimate(float(inside[-1])),
        }
        numbers |= {"rmse_over_bound": known} if known is not None else {}
        suite.rows += [Row.of(k, v, estimator="joint", **common) for k, v in numbers.items()]
    head = ("condition", "n", "left out", "over the bound", "over exact-kf", "NEES")
    suite.tables = [
        Table(
            "joint, told nominal tyres",
            (*head, *(f"in {100.0 * each:.0f} %" for each in COVERED)),
            lines,
            "left out: episodes that end early, in which tyres as they were drawn make the car "
            "unstable. in 50 %: share of the errors within the interval of that confidence.",
        )
    ]
    suite.verdict = _answer(over, against)
    _draw(suite, over)
    return suite


def _answer(over: Mapping[str, Mapping[str, Estimate]], against: Mapping[str, Estimate]) -> str:
    ours = [each["joint"].value for each in over.values()]
    theirs = [each["exact-kf"].value for each in over.values()]
    worst = max(over, key=lambda name: over[name]["joint"].value)
    change = [name for name in against if name not in over][:2]
    return verdict(
        "A filter believes in the tyres of a data sheet; a real car's are 40 % softer or stiffer.",
        f"joint, which estimates them, is {min(ours):.2f} to {max(ours):.2f} of the error of a "
        f"filter that knows them (worst: {worst}).",
        f"exact-kf, which believes in the data sheet, {min(theirs):.1f} to {max(theirs):.1f}.",
        "Why: after a change of tyres a bank of four has "
        f"{against[change[0]].value / against[change[1]].value:.2f} of one filter's error.",
        "Not covered: recorded cars, whose noise and forces are not known: `sideslip replay`.",
    )


def _draw(suite: Suite, over: Mapping[str, Mapping[str, Estimate]]) -> None:
    """One picture; nothing where plotly is not installed."""
    try:
        from .report.figures import groups_with_interval
    except ModuleNotFoundError:
        return
    bars = groups_with_interval(
        {k: dict(v) for k, v in over.items()},
        "error / that of a filter that knows the tyres: less is better",
        {1.0: "knows the tyres"},
    )
    text = suite.verdict.splitlines()[1]
    suite.answers.append(("What does it cost not to know the tyres?", bars, text))
