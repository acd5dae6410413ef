"""The episode loop, and an episode as a table of every signal with its unit."""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ..envs.io import atomic_file
from ..envs.numerics import require_extra
from ..envs.numerics.primitives import Scalar
from ..envs.record import Array, Log, concatenate
from ..envs.task import Infos, make_space
from ..envs.validation import short_repr
from ..envs.vehicle.parameters import Vehicle
from .env_info import CarEnv, CarVectorEnv

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

COST_FLOOR = 0.001  # added to an episode's cost in logarithms and ratios: less makes no difference


class EpisodeStep(NamedTuple):
    """The outcome of an env-step as the env returns it; of a vector env, one row for each car.

    The first one is the reset, whose action and reward are zero.
    """

    obs: Any  # (k,) or (N, k)
    info: Infos
    action: Any  # before this outcome, (width,) or (N, width)
    reward: Scalar  # of the row or (N,)
    terminated: bool | npt.NDArray[np.bool_]  # whether the episode ended by itself
    truncated: bool | npt.NDArray[np.bool_]  # whether it reached its time limit
    running: npt.NDArray[np.bool_]  # rows that are in their first episode, (N,)


def iterate_steps(
    env: CarEnv | CarVectorEnv, agent: Any = None, seeds: Any = None,
    options: dict[str, Any] | None = None,
) -> Iterator[EpisodeStep]:  # fmt: skip
    """Iterate over the steps of each row's first episode, until the last row's is over.

    Args:
        env: Env, single or vector.
        agent: Object with stable-baselines3's `predict`, else TypeError; ValueError for one of
            another full scale. None leaves the cars uncontrolled.
        seeds: Seed or seeds of the env's reset.
        options: Options of the env's reset.

    Yields:
        The reset, then every step.
    """
    if not (agent is None or hasattr(agent, "predict")):
        text = f"an agent has stable-baselines3's predict, got {type(agent).__name__}"
        raise TypeError(f"{text}; make_agent builds one from a name")
    obs, info = env.reset(seed=seeds, options=options)
    _check_full_scale(env, agent)
    running = np.ones(getattr(env, "num_envs", 1), np.bool_)
    action, state, start = np.zeros(env.action_space.shape or (1,), np.float32), None, running
    yield EpisodeStep(obs, info, action, 0.0, False, False, running)
    while running.any():
        if agent is not None:
            action, state = agent.predict(obs, state, start, deterministic=True)
        obs, reward, terminated, truncated, info = env.step(action)
        yield EpisodeStep(obs, info, action, reward, terminated, truncated, running)
        start = np.atleast_1d(np.logical_or(terminated, truncated))
        running = running & ~start


def _check_full_scale(env: CarEnv | CarVectorEnv, agent: Any) -> None:
    """Raise ValueError for an agent whose actions have another full scale than the car."""
    designed, cars = getattr(agent, "full_scale", None), getattr(env.unwrapped, "vehicle", ())
    if not isinstance(designed, float) or not getattr(agent, "needs", True):
        return  # who reads nothing does nothing
    for car in [cars] if isinstance(cars, Vehicle) else cars:
        if not math.isclose(designed, car.yaw_moment_limit, rel_tol=1e-9):
            raise ValueError(
                f"the agent's full scale is {designed:g} N m, the car's {car.yaw_moment_limit:g}: "
                "make the agent for an env that has this vehicle from the start"
            )


def evaluate_episodes(env: CarVectorEnv, agent: Any, seeds: Sequence[int]) -> tuple[Array, Array]:
    """Evaluate the cost J (N,) and the steps (N,) of each seed's first episode.

    Args:
        env: Vector env of N rows.
        agent: Agent, as for `iterate_steps`.
        seeds: N seeds.
    """
    costs, lengths = np.zeros(env.num_envs), np.full(env.num_envs, -1.0)  # the reset is no step
    for step in iterate_steps(env, agent, list(seeds)):
        costs -= np.where(step.running, step.reward, 0.0)
        lengths += step.running
    return costs, lengths


def compute_cost_ratios(costs: Array, others: Array) -> Array:
    """Compute ratios (N,) of costs on the same seeds, each with `COST_FLOOR` added.

    Args:
        costs: Costs J, shape (N,).
        others: Costs J to compare with, shape (N,).
    """
    return np.asarray((costs + COST_FLOOR) / (others + COST_FLOOR))


_INFO_UNITS = {
    **{"t": "s", "gamma": "rad/s", "gamma_ref": "rad/s", "yaw_moment": "N m"},
    **dict.fromkeys(("beta", "psi", "beta_ref", "steer", "phi"), "rad"),
    **{"v_x": "m/s", "v_y": "m/s", "y_l": "m", "X": "m", "Y": "m"},
}
TRUTH = ("beta", "gamma", "psi", "v_x", "v_y", "phi", "y_l")  # states in a log, as estimators' are
_DEGREES = 180.0 / np.pi
_NUMBER = Real | np.number | np.bool_
_ESTIMATE_COLOUR = "#56B4E9"
_STYLES: dict[str, dict[str, Any]] = {  # by the curve's label; others are of what is true
    "estimate, 1 std": {"color": _ESTIMATE_COLOUR, "lw": 1.0},
    "reference": {"color": "#D55E00", "lw": 1.2, "ls": "--", "zorder": 2},
}
_TRUE_STYLE: dict[str, Any] = {"color": "#000000", "lw": 1.4, "zorder": 3}
_BETA = {"obs_beta_hat": "estimate, 1 std", "beta_ref": "reference", "beta": "true"}
_PANELS = {  # labels of the curves by column, and the factor to the unit, by the axis's label
    "sideslip angle / deg": (_BETA, _DEGREES),
    "yaw rate / (deg/s)": ({"gamma_ref": "reference", "gamma": "true"}, _DEGREES),
    "yaw moment / (N m)": ({"yaw_moment": "delivered"}, 1.0),
    "steering angle / deg": ({"steer": "front wheels"}, _DEGREES),
}


@dataclass(frozen=True, repr=False)
class Rollout:
    """An episode: row 0 is the reset, row k the state after the k-th step.

    Columns are `info`, true motion, observation (`obs_...`), action before the row, and reward.
    """

    columns: dict[str, Array]  # a value for each row
    units: dict[str, str]  # by column
    log: Log  # record of every tick, with the truth at the ticks of the rows

    def __getitem__(self, name: str) -> Array:
        if name not in self.columns:
            raise KeyError(f"no signal {name!r}; there are: {', '.join(self.columns)}")
        return self.columns[name]

    def __repr__(self) -> str:
        size = f"{len(self.columns)} signals x {len(self.columns['t'])} rows"
        return f"<Rollout of {self.log.name}: {size}, cost {self.cost:.4g}>"

    @property
    def cost(self) -> float:
        """The episode's cost J: minus the env's own return."""
        costs = self.columns.get("cost", -self.columns["reward"])  # a wrapper may change rewards
        return float(costs.sum())

    @property
    def failed(self) -> bool:
        """Whether the episode ended by a failure."""
        return bool(self.columns["failure"][-1])

    def _repr_png_(self) -> bytes | None:
        """Draw the picture that a notebook shows; None without matplotlib."""
        try:
            figure = self.plot()
        except ModuleNotFoundError:
            return None
        picture = BytesIO()
        figure.savefig(picture, format="png", dpi=80)
        return picture.getvalue()

    def to_pandas(self) -> "DataFrame":
        """Make the table, a row for each step, with units in `attrs["units"]` (needs `report`)."""
        with require_extra("report", "to_pandas needs pandas"):
            from pandas import DataFrame

        table = DataFrame(self.columns)
        table.attrs["units"] = dict(self.units)
        return table

    def to_parquet(self, path: str | Path) -> None:
        """Write the table, with units in the columns' metadata (needs the extra `report`).

        Args:
            path: File to write.
        """
        with require_extra("report", "to_parquet needs pyarrow"):
            import pyarrow as pa
            import pyarrow.parquet as pq

        units = {name: {"unit": self.units[name]} for name in self.columns}
        fields = [pa.field(name, pa.float64(), metadata=unit) for name, unit in units.items()]
        with atomic_file(path) as file:
            pq.write_table(pa.table([*self.columns.values()], schema=pa.schema(fields)), file)

    def plot(self) -> "Figure":
        """Plot sideslip angle, yaw rate, yaw moment and steering over time (needs `report`)."""
        with require_extra("report", "plot needs matplotlib"):
            from matplotlib.figure import Figure

        figure = Figure(figsize=(8.0, 7.0), layout="constrained")
        axes = figure.subplots(4, 1, sharex=True)
        t, columns = self.columns["t"], self.columns
        for axis, (label, (names, scale)) in zip(axes, _PANELS.items(), strict=True):
            for name, text in names.items():
                # a task that judges the sideslip angle alone has no reference of the yaw rate
                if name in columns and (name != "gamma_ref" or columns[name].any()):
                    style = _STYLES.get(text, _TRUE_STYLE)
                    axis.plot(t, scale * columns[name], label=text, **style)
            if "obs_beta_hat" in names and {"obs_beta_hat", "obs_beta_std"} <= columns.keys():
                estimate, std = columns["obs_beta_hat"], columns["obs_beta_std"]
                low, high = (scale * (estimate + x * std) for x in (-1.0, 1.0))
                axis.fill_between(t, low, high, color=_ESTIMATE_COLOUR, alpha=0.3, lw=0)
            axis.set_ylabel(label)
            axis.grid(alpha=0.3)
            axis.legend(loc="best", fontsize="small")
        axes[-1].set_xlabel("time / s")
        figure.suptitle(f"{self.log.name}: cost {self.cost:.3g}")
        return figure


def rollout(
    env: CarEnv | str, agent: Any = None, seed: int | None = 0,
    options: dict[str, Any] | None = None,
) -> Rollout:  # fmt: skip
    """Run one episode.

    Args:
        env: Single env of this package, or its id; TypeError for another env.
        agent: Agent, as for `iterate_steps`, with its errors.
        seed: Seed of the reset.
        options: Options of the reset.
    """
    if isinstance(env, str):
        with contextlib.closing(gym.make(env)) as new_env:
            return rollout(new_env, agent, seed, options)
    if not (isinstance(env, gym.Env) and env.has_wrapper_attr("layout")):
        text = f"rollout runs one env of this package, got {short_repr(env)}"
        raise TypeError(f"{text}; agents.rollout.evaluate_episodes runs a vector env")
    base: Any = env.unwrapped
    layout, rows, records = env.get_wrapper_attr("layout"), [], []
    for step in iterate_steps(env, agent, seed, options):
        motion = base.motion
        info = step.info | {name: getattr(motion, name) for name in ("v_x", "v_y", "phi")}
        info["y_l"] = motion.y + base.vehicle.preview * (motion.psi - motion.theta)
        info |= {"X": motion.X, "Y": motion.Y}  # y_l: tie-vision (4)
        info = {x: value for x, value in info.items() if isinstance(value, _NUMBER)}
        info.pop("is_success", None)
        rows.append([*map(float, (*info.values(), step.reward, *step.action, *np.ravel(step.obs)))])
        records.append(base.record)
    names, width = [*info, "reward"], len(step.action)
    names += ["action"] if width == 1 else [f"action_{i}" for i in range(width)]
    # a wrapper may change the observation: its entries have no name and no unit
    has_layout = env.observation_space == make_space(layout)
    entries = {f"obs_{entry.name}": entry.unit for entry in layout} if has_layout else {}
    names += list(entries) or [f"obs_{i}" for i in range(step.obs.size)]
    # wrappers may put a prefix before beta's estimates in `info`
    estimates = {name: "rad" for name in names if name.endswith(("beta_hat", "beta_std"))}
    units = {name: _INFO_UNITS.get(name, "-") for name in names} | estimates | entries
    columns = dict(zip(names, np.array(rows).T, strict=True))
    record = concatenate(records)
    t = record.ticks * record.dt  # the truth between rows is interpolated
    truth = {name: np.interp(t, columns["t"], columns[name]) for name in TRUTH}
    return Rollout(columns, units, Log(record, base.slow_sensors, truth, base.scenario.name))
