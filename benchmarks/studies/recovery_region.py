"""The suite `recovery`: from which sideslip angle and yaw rate a controller still saves the car.

Cars start straight ahead but sliding and turning, nobody steers, and the seed draws tyres and
friction. A car is saved that does not fail and ends with a sideslip angle below 0.05 rad.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from ...agents.rollout import iterate_steps
from ...envs.record import Array
from ...envs.scenarios.draws import KMH
from ..control.entries import REFERENCE_FILTER, Entry
from ..control.tasks import YAW, ControlTask
from ..harness.results import Column, ResultTable, ShareMap, Suite
from ..harness.stats import interval, mean_share
from ..harness.verdict import format_verdict, summarise_names
from ..report.study import Request, Study

_READING = ("two-dof", "esc", "sliding-mode", "lqr")
ORACLES = ("oracle-state-lqr", "oracle-state-nmpc")
CONTROLLERS = ("none", *_READING, "nominal", *ORACLES)
CLAIRVOYANT = "clairvoyant"
_PULSES = tuple((side, 0.05 * 1.4**k) for side in (-1.0, 1.0) for k in range(10))
"""Full yaw moment to the right or left, for how long (s), before an oracle goes on."""
_TRIES = 5  # in a batch
_CAUGHT = 0.05  # rad
SEEDS = 16, 4  # of a usual and of a quick run
POINTS = (13, 11), (5, 5)  # of the grid: sideslip angles, yaw rates
MAX_START = (0.45, 1.0)  # rad and rad/s, where the grid ends
FIRST_SEED = 2**28

_SCENARIO = {"base": "recovery", "initial_beta": 0.0, "initial_gamma": 0.0, "half_width": 1e6}
CARS: dict[str, tuple[ControlTask, dict[str, Any]]] = {
    f"{car} at {kmh:g} km/h": (
        ControlTask("", YAW, car, reference, "recovery"),
        _SCENARIO | {"speed": kmh * KMH, "friction": friction},
    )
    for car, kmh, reference, friction in (
        ("passenger-car", 80.0, "limited", (0.6, 0.9)),
        ("coms", 40.0, "model", (0.7, 1.0)),
    )
}
"""The task of each car, whose class has the tuned options, and the scenario."""


@dataclass(frozen=True)
class RecoveryCase:
    """A controller on a car of `CARS`, over a grid of starts, after each of some pulses.

    pulses: Fraction of the full yaw moment, and duration (s).
    """

    car: str
    controller: str
    points: tuple[int, int]
    seeds: int
    pulses: tuple[tuple[float, float], ...] = ((0.0, 0.0),)


@dataclass
class _PulseThenAgent:
    """An agent that takes over each row after a pulse."""

    agent: Any  # anything with stable-baselines3's `predict`
    share: Array  # fraction of the full moment, shape (rows,)
    decisions: Array  # how many decisions the pulse lasts, shape (rows,)

    def predict(
        self,
        observation: Array,
        state: tuple[int, Any] | None = None,
        episode_start: object = None,
        deterministic: bool = True,
    ) -> tuple[Array, tuple[int, Any]]:
        """Return the agent's action, the pulse's while that lasts, and the next state."""
        count, inner = state or (0, None)
        action, inner = self.agent.predict(observation, inner, episode_start, deterministic)
        combined = np.where(count < self.decisions, self.share, np.ravel(action))
        return combined.reshape(np.shape(action)), (count + 1, inner)


def _make_grid(points: tuple[int, int]) -> tuple[Array, Array]:
    """Make the sideslip angles (rad) and yaw rates (rad/s) of the starts."""
    axes = zip(MAX_START, points, strict=True)
    beta, gamma = (np.linspace(-limit, limit, n) for limit, n in axes)
    return beta, gamma


def _compute_recovery_mask(case: RecoveryCase) -> Array:
    """Mark with 1 where a pulse lets the car be saved, shape (yaw rates, slip angles, seeds)."""
    task, scenario = CARS[case.car]
    beta, gamma = _make_grid(case.points)
    tries = len(case.pulses)
    starts = [(g, b) for g in gamma for b in beta] * tries
    v_x, indices = scenario["speed"], range(case.seeds)
    states = [{"v_y": v_x * math.tan(b), "gamma": g} for g, b in starts for _ in indices]
    seeds = [FIRST_SEED + i for i in indices] * len(starts)
    reads = REFERENCE_FILTER if case.controller in _READING else ""
    task = replace(task, changes={"scenario": scenario})
    env, agent = Entry(case.controller, reads).make(task, len(states))
    share, seconds = np.repeat(case.pulses, len(states) // tries, axis=0).T
    agent = _PulseThenAgent(agent, share, np.round(seconds / task.control_period))
    lost, last = np.zeros(len(states), np.bool_), np.zeros(len(states))
    for step in iterate_steps(env, agent, seeds, {"state": states}):
        lost |= step.running & (step.info["failure"] != 0)
        last = np.where(step.running, step.info["beta"], last)
    env.close()
    shape = (tries, len(gamma), len(beta), case.seeds)
    caught = (~lost & (np.abs(last) < _CAUGHT)).astype(float).reshape(shape)
    return np.asarray(caught.max(axis=0))


def _measure(request: Request) -> dict[str, dict[str, Array]]:
    """Masks of `_compute_recovery_mask` by car and controller."""
    grid = request.choose(*POINTS), request.choose(*SEEDS)
    cases = [RecoveryCase(car, name, *grid) for car in CARS for name in CONTROLLERS]
    starts = [_PULSES[k : k + _TRIES] for k in range(0, len(_PULSES), _TRIES)]
    cases += [RecoveryCase(car, ORACLES[0], *grid, item) for car in CARS for item in starts]
    masks = request.run_cases(_compute_recovery_mask, cases, "recovery")
    results = dict(zip(cases, masks, strict=True))
    cars = {}
    for car in CARS:
        cars[car] = {name: results[RecoveryCase(car, name, *grid)] for name in CONTROLLERS}
        car_masks = [item for case, item in results.items() if case.car == car]
        cars[car][CLAIRVOYANT] = np.maximum.reduce(car_masks)
    return cars


def _add_figures(suite: Suite, _: object, draw: ModuleType) -> None:
    """Add the maps, those of the best first."""
    text = "Colour: the share of seeds on which the car is saved; the line is at one half."
    suite.figures = [(item.title, draw.draw_share_maps(item), text) for item in suite.maps]
    first, best = suite.maps[0], suite.verdict.splitlines()[1:-2]
    shown = ["none"]
    for group in (_READING, ORACLES, (CLAIRVOYANT,)):
        names = [name for name in group if name in first.shares]
        shown += sorted(names, key=lambda name: -float(first.shares[name].mean()))[:1]
    selected = replace(first, shares={name: first.shares[name] for name in shown})
    title = f"From where is a car still saved? ({first.title})"
    suite.answers.append((title, draw.draw_share_maps(selected), " ".join([*best[:1], text])))


def _compose_verdict(cars: Mapping[str, Mapping[str, Array]]) -> str:
    firsts, knowing, clairvoyant_shares = list[str](), list[str](), list[str]()
    for car, masks in cars.items():
        share = {name: values.mean(axis=(0, 1)) for name, values in masks.items()}  # (seeds,)
        mean = {name: 100.0 * float(values.mean()) for name, values in share.items()}
        rivals = sorted((name for name in _READING if name in mean), key=lambda name: -mean[name])
        even = [name for name in rivals if not interval(share[rivals[0]] - share[name]).low > 0.0]
        best = " and ".join(even) if len(even) < 3 else f"{summarise_names(even, 1)}, a tie,"
        rest = [name for name in rivals if name not in even][:1] + ["none"] * ("none" in mean)
        others = ", ".join(f"{name} {mean[name]:.0f} %" for name in rest)
        if rivals:
            firsts.append(f"{car}: {best} {mean[rivals[0]]:.0f} %; {others}.")
        known = [mean[name] for name in ORACLES if name in mean]
        knowing += [f"{share:.0f} %" for share in sorted(known)[-1:]]
        clairvoyant_shares += [f"{mean[name]:.0f} %" for name in (CLAIRVOYANT,) if name in mean]
    why = f"Why: knowing the exact motion saves {' and '.join(knowing)}, foresight too "
    why += f"{' and '.join(clairvoyant_shares)}; filters must find it first."
    return format_verdict(
        "Cars start sliding and turning and nobody steers; saved: going straight again within 5 s.",
        *firsts,
        why if knowing else "",
        "Not covered: a driver who steers against the slide, and starts beyond the grid.",
    )


def _add_tables(suite: Suite, cars: Mapping[str, Mapping[str, Array]]) -> None:
    """Add table, rows and maps; the seeds are what varies, the starts are the same for all."""
    for car, masks in cars.items():
        shares = {name: mask.mean(axis=(0, 1)) for name, mask in masks.items()}
        records = [
            {
                "controller": name,
                "saved_rate": mean_share(share),
                "above none": interval(share - shares["none"]),
            }
            for name, share in shares.items()
        ]
        n_gamma, n_beta, seeds = masks["none"].shape
        suite.add_rows(records, YAW, scenario=car, n=seeds)
        note = (
            f"Of {n_gamma * n_beta} starts up to {np.degrees(MAX_START[0]):.0f} deg and "
            f"{np.degrees(MAX_START[1]):.0f} deg/s, {seeds} seeds each; intervals over the seeds, "
            "paired against none."
        )
        suite.tables.append(ResultTable(car, _COLUMNS, records, note))
        beta, gamma = (np.degrees(axis) for axis in _make_grid((n_beta, n_gamma)))
        by_start = {name: item.mean(axis=2) for name, item in masks.items()}
        labels = ("sideslip angle / deg", "yaw rate / (deg/s)")
        suite.maps.append(ShareMap(f"{car}: share of cars saved", beta, gamma, by_start, *labels))


_COLUMNS = (
    "controller",
    Column("saved_rate", "saved / %", 100.0, ".1f"),
    Column("above none", "above none / %", 100.0, ".1f"),
)
STUDY = Study(
    "recovery",
    "From where the car is still saved",
    "The share of cars that are saved over the sideslip angle and yaw rate they start with: no "
    f"failure within 5 s, and below {_CAUGHT} rad at the end. Nobody steers; the yaw moment alone "
    "acts. The seed draws tyres and friction. Filters start at zero, as after a cold start: they "
    "have to find the slide first; the two oracles know it, and the car. clairvoyant: whatever any "
    f"of them saves, or one of {len(_PULSES)} tries with full moment to one side for 0.05 to "
    "1 s and an oracle from then on: of such pieces the run that just saves a car is made "
    "(Pontryagin), so that this is a lower bound of what can be saved, and probably near it.",
    SEEDS,
    _measure,
    _add_tables,
    _compose_verdict,
    _add_figures,
)
