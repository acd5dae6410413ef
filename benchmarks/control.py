"""Question: which controller keeps the sideslip angle small? On the papers' tie-vision-fig8."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from rich.console import Console

from .. import __version__
from ..agents import make_agent
from ..agents.rollout import rollout
from ..envs import scenario_from
from ..estimators import EstimateObservation
from .cases import run_cases
from .rows import Row, Suite, Table
from .stats import interval, mean

Array = npt.NDArray[np.float64]

SEEDS = 20
QUICK_SEEDS = 4
ENV_ID = "sideslip/YawVision-v0"
PAPER = "tie-vision Fig. 8"
SCENARIOS = {
    "tie-vision-fig8": "tyres as the controller believes",
    "tie-vision-fig8-stiff": "tyres 1.2 times stiffer",
}


@dataclass(frozen=True)
class Contestant:
    """A controller with the estimator it reads ("" where it reads none)."""

    label: str
    agent: str
    estimator: str = ""
    rate: str | None = None


CONTESTANTS = (
    Contestant("none", "none"),
    Contestant("feedforward", "feedforward"),
    Contestant("single-rate", "two-dof", "single-rate-kf", "camera"),
    Contestant("multirate", "two-dof", "multirate-kf", "control"),
    Contestant("multirate-residual", "two-dof", "multirate-residual-kf", "control"),
)
_TOLD = {"camera_psi": "psi_noise", "camera_y": "y_l_noise"}
METRICS = ("rms_slip", "peak_slip", "largest_step", "saturation", "cost")


@dataclass(frozen=True)
class Case:
    """One contestant on one scenario and seed."""

    scenario: str
    contestant: int
    seed: int


@dataclass
class Measured:
    """The numbers of METRICS, and time series (t, beta, yaw moment) of seed 0."""

    numbers: Array
    series: tuple[Array, Array, Array] | None


def told_noise(scenario: str) -> dict[str, float]:
    """The scenario's camera noise as options of an estimator: a filter knows its sensors."""
    noise = scenario_from(scenario).noise
    return {told: noise[name] for name, told in _TOLD.items() if name in noise}


def make_env(scenario: str, contestant: Contestant) -> gym.Env[Any, Any]:
    """The env of a contestant: 1 ms control, its estimator in front."""
    env: gym.Env[Any, Any] = gym.make(
        ENV_ID, scenario=scenario, control_period=1, on_bad_action="fail"
    )
    if contestant.estimator:
        env = EstimateObservation(env, contestant.estimator, options=told_noise(scenario))
    return env


def measure(case: Case) -> Measured:
    """Drive one episode and reduce it to the numbers of METRICS."""
    contestant = CONTESTANTS[case.contestant]
    env = make_env(case.scenario, contestant)
    options = {"rate": contestant.rate} if contestant.rate else {}
    agent = make_agent(contestant.agent, env, **options)
    drive = rollout(env, agent, case.seed)
    base: Any = env.unwrapped
    slip, moment = drive["beta"], drive["yaw_moment"]
    numbers = np.array(
        [
            np.sqrt(np.mean(slip**2)),
            np.max(np.abs(slip)),
            np.max(np.abs(np.diff(moment))),
            np.mean(np.abs(moment) >= 0.999 * base.vehicle.yaw_moment_limit),
            drive.cost,
        ]
    )
    return Measured(numbers, (drive["t"], slip, moment) if case.seed == 0 else None)


def run(seeds: int = SEEDS, jobs: int | None = None, console: Console | None = None) -> Suite:
    """Every contestant on both scenarios and the seeds 0 .. seeds-1."""
    cases = [
        Case(scenario, c, seed)
        for scenario in SCENARIOS
        for c in range(len(CONTESTANTS))
        for seed in range(seeds)
    ]
    results = run_cases(measure, cases, "control", jobs, console)
    suite = Suite(
        "control",
        "Which controller keeps the sideslip angle small",
        "A single lane change at 25 km/h; the yaw moment of two in-wheel motors shall keep the "
        "sideslip angle at zero. none: the uncontrolled car. feedforward: tie-vision (24). "
        "single-rate and multirate: feedforward and the same PI on an estimate, decided every 33 "
        "ms and every millisecond. The filters are told the camera's noise. Intervals are 95 % "
        "bootstrap over seeds.",
    )
    for scenario, text in SCENARIOS.items():
        mine = [(c, r) for c, r in zip(cases, results, strict=True) if c.scenario == scenario]
        numbers = np.array(
            [[r.numbers for c, r in mine if c.contestant == k] for k in range(len(CONTESTANTS))]
        )
        series = {
            CONTESTANTS[c.contestant].label: r.series for c, r in mine if r.series is not None
        }
        _add(suite, scenario, text, numbers)
        _draw(suite, text, series)
    return suite


def _add(suite: Suite, scenario: str, text: str, numbers: Array) -> None:
    """Rows and the table of a scenario; numbers: (contestants, seeds, METRICS)."""
    n = numbers.shape[1]
    cells = []
    for k, contestant in enumerate(CONTESTANTS):
        env = make_env(scenario, contestant)
        spread = [interval(numbers[k, :, i], mean) for i in range(len(METRICS))]
        suite.rows += [
            Row(
                suite.name,
                scenario,
                metric,
                value,
                estimator=contestant.estimator,
                controller=contestant.agent,
                low=low,
                high=high,
                n=n,
                salt="fixed",
                env_version=f"{ENV_ID} {__version__}",
                spec=env.spec.to_json() if env.spec is not None else "",
                paper=PAPER,
            )
            for metric, (value, low, high) in zip(METRICS, spread, strict=True)
        ]
        rms, peak, step, saturation, cost = (value for value, _, _ in spread)
        none = float(np.mean(numbers[0, :, 0]))
        cells.append(
            [
                contestant.label,
                f"{1e3 * rms:.2f}",
                f"{rms / none:.2f}",
                f"{1e3 * peak:.2f}",
                f"{step:.1f}",
                f"{100 * saturation:.1f}",
                f"{cost:.3f}",
            ]
        )
    suite.tables.append(
        Table(
            f"{PAPER}, {text} ({n} seeds)",
            (
                "controller",
                "RMS slip / mrad",
                "over none",
                "peak slip / mrad",
                "largest step / N m",
                "sat. / %",
                "cost",
            ),
            cells,
            "The largest step is that of the delivered yaw moment between two milliseconds.",
        )
    )


def _draw(suite: Suite, text: str, series: dict[str, tuple[Array, Array, Array]]) -> None:
    """The paper's two panels; nothing where plotly is not installed."""
    try:
        from .figures import time_series
    except ModuleNotFoundError:
        return
    t = next(iter(series.values()))[0]
    slip = {label: 1e3 * s[1] for label, s in series.items()}
    moment = {label: s[2] for label, s in series.items() if label != "none"}
    suite.figures += [
        (
            f"{PAPER} (a), {text}: sideslip angle (seed 0)",
            time_series("", t, slip, "sideslip angle / mrad"),
            "Closer to zero is better.",
        ),
        (
            f"{PAPER} (b), {text}: yaw moment (seed 0)",
            time_series("", t, moment, "yaw moment / (N m)"),
            "What the motors delivered.",
        ),
    ]
