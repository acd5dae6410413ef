"""Controllers over the papers' manoeuvres, and the papers' figures from an example's signals.

tie-vision's controllers are measured by the sideslip angle that they leave, dakf-stability's by how
well the car follows its reference model.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...agents import make_agent
from ...agents.rollout import Rollout, rollout
from ...envs.record import PACKET, Array
from ...envs.scenarios.manoeuvres import make_scenario
from ...envs.scenarios.scenario import Scenario
from ..harness.drives import make_env
from ..harness.parallel import split_seeds
from .ledger import (
    FIRST,
    Example,
    Numbers,
    SimulationResult,
    collect_numbers,
    get_paper_tuning,
    rms,
)

_Manoeuvre = str | Mapping[str, Any] | Scenario

_ENV_ID = "sideslip/AfsYawFusion-v0"
_STATES = ("beta", "gamma", "d1", "d2")


@dataclass(frozen=True)
class Tracking:
    """The errors of an episode from its reference, over all ticks."""

    rms_beta: float  # rad, of the error
    rms_gamma: float  # rad/s, of the error
    peak_beta: float  # rad, of the sideslip angle itself
    saturated: float  # fraction of the ticks that command the whole yaw moment
    steered: float  # largest fraction of the steering's authority that was commanded
    failed: bool


def run_episode(
    seed: int,
    scenario: _Manoeuvre = "dakf-fig7",
    agent: str = "model-following",
    estimator: str = "dakf",
    **options: Any,
) -> Rollout:
    """Run an episode at 1 ms with GPS, gyro and camera on board; the estimator uses the GPS.

    Args:
        seed: Seed of the episode.
        scenario: Scenario as `make_scenario` reads it.
        agent: Controller; "none" is the steer-by-wire car without control.
        estimator: Name of the estimator, tuned for its paper.
        **options: Options of the controller (`bandwidth`, `rejection`).

    Returns:
        The episode.
    """
    tuned = dict(get_paper_tuning(estimator))
    estimate = {"outputs": _STATES, "options": {"slow": "gps"} | tuned}
    env = make_env(_ENV_ID, estimator, estimate, scenario=scenario, control_period=1)
    return rollout(env, make_agent(agent, env, **options), seed)


def measure_tracking(episode: Rollout) -> Tracking:
    """Measure how an episode of `run_episode` tracks its reference."""
    moment, steering = np.abs(episode["action_0"]), np.abs(episode["action_1"])
    return Tracking(
        rms_beta=rms(episode["beta"] - episode["beta_ref"]),
        rms_gamma=rms(episode["gamma"] - episode["gamma_ref"]),
        peak_beta=float(np.abs(episode["beta"]).max()),
        saturated=float(np.mean(moment >= 1.0)),
        steered=float(steering.max()),
        failed=episode.failed,
    )


SIGNALS = ("beta", "gamma", "steer", "yaw_moment")
_CONTESTANTS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "none": ("none", "", {}),
    "feedforward": ("feedforward", "", {}),
    "single-rate": ("two-dof", "single-rate-kf", {"rate": "camera"}),
    "multirate": ("two-dof", "multirate-kf", {"rate": "control"}),
    "multirate-residual": ("two-dof", "multirate-residual-kf", {"rate": "control"}),
}
"""tie-vision Fig. 8, by label: agent, the estimator it reads ("" for none) and its options."""
_NOISE = {"camera_psi": "psi_noise", "camera_y": "y_l_noise"}


@dataclass(frozen=True)
class SlipSimulation:
    """tie-vision's controllers on a lane change, each with a filter that knows the camera's noise.

    Numbers of each: RMS and peak of the slip, the largest change of the yaw moment in 1 ms, the sum
    of all its changes and the fraction of time at its limit.
    """

    name: str
    scenario: str
    contestants: tuple[str, ...]  # of `_CONTESTANTS`, or with a remark behind a comma
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # more ones of the agent

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """Split the seeds into cases."""
        return split_seeds(seeds, 2)

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult:
        """Drive every contestant on each seed."""
        return _measure_agents(seeds, self.contestants, self._run_episode)

    def _run_episode(self, label: str, seed: int) -> tuple[Rollout, dict[str, float]]:
        agent, estimator, options = _CONTESTANTS[label.partition(",")[0]]
        noise = make_scenario(self.scenario).noise
        known = {option: noise[name] for name, option in _NOISE.items() if name in noise}
        how: dict[str, Any] = {"scenario": self.scenario, "control_period": 1}
        env = make_env("sideslip/YawVision-v0", estimator, {"options": known}, **how)
        more = self.options.get(label, {})
        drive = rollout(env, make_agent(agent, env, **{**options, **more}), seed)
        base: Any = env.unwrapped
        slip, moment, limit = drive["beta"], drive["yaw_moment"], base.vehicle.yaw_moment_limit
        change = np.abs(np.diff(moment))
        return drive, {
            "rms_slip": rms(slip),
            "peak_slip": float(np.max(np.abs(slip))),
            "largest_step": float(np.max(change)),
            "total_variation": float(np.sum(change)),
            "saturation": float(np.mean(np.abs(moment) >= 0.999 * limit)),
        }


def _measure_agents(
    seeds: tuple[int, ...],
    labels: Iterable[str],
    drive: Callable[[str, int], tuple[Rollout, dict[str, float]]],
) -> SimulationResult:
    """Measure every contestant on each seed, with the signals of the first seed."""
    lines, example = [], None
    for seed in seeds:
        numbers: Numbers = {}
        curves: dict[str, dict[str, Array]] = {}
        for label in labels:
            episode, values = drive(label, seed)
            if episode.failed:  # fewer ticks are no better drive
                raise RuntimeError(f"{label}: the car of seed {seed} failed")
            numbers |= {(label, name): value for name, value in values.items()}
            curves[label] = {name: episode[name] for name in SIGNALS}
        lines.append(numbers)
        if seed == FIRST:
            curves["reference"] = {name: episode[f"{name}_ref"] for name in ("beta", "gamma")}
            example = Example(episode["t"], curves)
    return SimulationResult(collect_numbers(lines), example)


@dataclass(frozen=True)
class FollowingSimulation:
    """dakf-stability's controller by wire, with and without parts of it; numbers of `Tracking`."""

    name: str
    scenario: str | Mapping[str, Any]
    agents: Mapping[str, Mapping[str, Any]]  # options of `run_episode` by label
    share: float = 1.0  # of the seeds that are driven

    def chunks(self, seeds: int) -> list[tuple[int, ...]]:
        """Split the seeds into cases."""
        return split_seeds(max(1, round(self.share * seeds)), 2)

    def measure(self, seeds: tuple[int, ...]) -> SimulationResult:
        """Drive every agent on each seed."""
        return _measure_agents(seeds, self.agents, self._run_episode)

    def _run_episode(self, label: str, seed: int) -> tuple[Rollout, dict[str, float]]:
        drive = run_episode(seed, self.scenario, **self.agents[label])
        values = vars(measure_tracking(drive))
        return drive, {name: float(value) for name, value in values.items()}


_Draw = Callable[[Example], Any]


@dataclass(frozen=True)
class PaperFigure:
    """One figure of a paper, redrawn."""

    paper: str
    title: str
    scenario: str  # name of the simulation
    draw: _Draw
    caption: str  # what to see


def _draw_lines(
    example: Example,
    series: Mapping[str, Array],
    y_label: str,
    window: tuple[float, float] | None = None,
    **more: Any,
) -> Any:
    """_Draw lines over time, in a window (s) of it; more: of `draw_time_series`."""
    from ..report.figures import draw_time_series

    t = example.time
    inside = (t >= window[0]) & (t <= window[1]) if window else np.ones(len(t), bool)
    shown = {name: signal[inside] for name, signal in series.items()}
    return draw_time_series(t[inside], shown, y_label, **more)


def make_curves(
    signal: str,
    y_label: str,
    labels: Sequence[str] = (),
    window: tuple[float, float] | None = None,
    x_label: str = "time / s",
) -> _Draw:
    """Make a figure of a signal over time, of all subjects or the labels, in a window (s)."""

    def draw(example: Example) -> Any:
        signals = {name: example.curves.get(name, {}) for name in labels or example.curves}
        series = {name: values[signal] for name, values in signals.items() if signal in values}
        return _draw_lines(example, series, y_label, window, x_label=x_label)

    return draw


def make_loops(y_label: str) -> _Draw:
    """Make a figure of open loops over frequency in Hz, on a logarithmic axis."""

    def draw(example: Example) -> Any:
        series = {name: signals["magnitude"] for name, signals in example.curves.items()}
        figure = _draw_lines(example, series, y_label, x_label="frequency / Hz")
        ends = np.log10(example.time[[0, -1]])
        figure.update_xaxes(type="log", range=[float(end) for end in ends])
        return figure

    return draw


def make_course(y_label: str, labels: Sequence[str]) -> _Draw:
    """Make a figure of the course psi + beta: truth, the receiver's samples, each filter's."""

    def draw(example: Example) -> Any:
        curves = {name: example.curves[name] for name in labels}
        series = {name: curve["psi"] + curve["beta"] for name, curve in curves.items()}
        series["measured"] = _extract_samples(example, "gps", 0, "arrived")
        return _draw_lines(example, series, y_label, dots=("measured",))

    return draw


def _extract_samples(example: Example, sensor: str, row: int, at: str) -> Array:
    """Extract a slow sensor's values at the ticks `captured` or `arrived`, NaN elsewhere."""
    values = np.full(len(example.time), np.nan)
    ticks = example.packets[sensor][:, getattr(PACKET, at)].astype(int)
    in_range = ticks < len(values)
    values[ticks[in_range]] = example.packets[sensor][in_range, PACKET.value + row]
    return values


def _repeat_samples(values: Array) -> Array:
    """Hold samples until the next one, as a controller without an estimator reads them."""
    known = np.flatnonzero(~np.isnan(values))
    last = np.searchsorted(known, np.arange(len(values)), side="right") - 1
    out = np.full(len(values), np.nan)
    out[last >= 0] = values[known[last[last >= 0]]]
    return out


def make_offset(y_label: str, labels: Sequence[str], window: tuple[float, float]) -> _Draw:
    """Make a figure of the lateral offset: truth, the camera's held late samples, each filter's."""

    def draw(example: Example) -> Any:
        series = {name: example.curves[name]["y_l"] for name in labels}
        series["measured, held"] = _repeat_samples(
            _extract_samples(example, "camera", 1, "arrived")
        )
        return _draw_lines(example, series, y_label, window)

    return draw


def draw_delays(example: Example) -> Any:
    """_Draw the delay of the newest frame over the time of its capture, for the first second."""
    packets = example.packets["camera"]
    late = np.full(len(example.time), np.nan)
    ticks = packets[:, PACKET.captured].astype(int)
    late[ticks] = packets[:, PACKET.arrived] - packets[:, PACKET.captured]
    return _draw_lines(example, {"camera": _repeat_samples(late)}, "delay / ms", (0.0, 1.0))
