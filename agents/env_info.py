"""Facts of an environment, single or vector, that controllers are designed from.

Args:
    env: Env, vector env or `VecEnv` of this package, wrapped or bare; TypeError for another.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ..envs.engine.config import EnvConfig
from ..envs.task import ObservationEntry, make_space
from ..envs.validation import short_repr
from ..envs.vehicle.parameters import Vehicle

_Value = TypeVar("_Value")
CarEnv = gym.Env[npt.NDArray[np.float32], npt.NDArray[np.float32]]
CarVectorEnv = VectorEnv[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[Any]]

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

    AnyEnv = CarEnv | CarVectorEnv | VecEnv
else:
    AnyEnv = Any  # stable-baselines3 comes with an extra, and needs a second to load

# Wrappers that keep observations and actions, by package and class name, so that none is imported.
# Vector versions have the same names. Those of this package may change the observation: their
# `layout` says how.
_TRANSPARENT = {
    "gymnasium": "Wrapper VectorWrapper OrderEnforcing PassiveEnvChecker TimeLimit Autoreset "
    "RewardWrapper VectorRewardWrapper ClipReward NormalizeReward TransformReward AddWhiteNoise "
    "DictInfoToList HumanRendering ObstructView RecordEpisodeStatistics RecordVideo "
    "RenderCollection VectorizeTransformReward",
    "stable_baselines3": "Monitor VecCheckNan VecMonitor VecNormalize VecVideoRecorder",
    __name__.partition(".")[0]: "CompactObservation EstimateObservation NativeObservation "
    "RewardScaleWrapper TruthObservation",
}
# A wrapper that overrides one of these may change observations or actions.
_CHANGES = {"reset", "step", "step_async", "step_wait", "observation", "observations", "action",
            "actions"}  # fmt: skip


class PlantKind(NamedTuple):
    """The variant of a plant, for the prediction of nonlinear MPC."""

    tyres: str  # the tyre law, of `TYRE_LAWS`
    small_angle: bool
    roll: bool
    lags: bool  # whether the actuators lag
    yaw_first: bool  # whether the yaw moment comes before the drive torque


@dataclass(frozen=True)
class EnvFacts:
    """The facts that controllers are designed from, but for `plants` the same for all rows."""

    layout: tuple[ObservationEntry, ...]  # of an observation
    nominal: Vehicle  # as controllers know it
    full_scale: float  # yaw moment at an action of 1 (N m)
    authority: float  # added steering angle at an action of 1 (rad)
    control_period: int  # ticks between two decisions
    reference: str  # name in `envs.task.REFERENCES`
    width: int  # number of entries of an action
    moment_rate: float  # s2, weight of the yaw moment's rate in the cost
    plants: frozenset[PlantKind]  # among the rows

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of an observation."""
        return tuple(entry.name for entry in self.layout)


@dataclass(frozen=True)
class EnvView:
    """The spaces and facts of a vector environment, from which an agent is built elsewhere.

    `make_agent`, `get_env_facts` and the controllers accept it as an env. It has no `reset`, no
    `step` and no seed: an agent built from it learns of the true car by observations alone.
    """

    num_envs: int  # rows, one car each
    facts: EnvFacts
    single_observation_space: gym.Space[npt.NDArray[np.float32]]
    single_action_space: gym.Space[npt.NDArray[np.float32]]

    @property
    def unwrapped(self) -> "EnvView":
        """The view itself, which has no wrappers."""
        return self

    @property
    def observation_space(self) -> gym.Space[npt.NDArray[np.float32]]:
        """Observation space of all rows."""
        return batch_space(self.single_observation_space, self.num_envs)

    @property
    def action_space(self) -> gym.Space[npt.NDArray[np.float32]]:
        """Action space of all rows."""
        return batch_space(self.single_action_space, self.num_envs)

    @property
    def layout(self) -> tuple[ObservationEntry, ...]:
        """Entries of the observation: names, units and bounds."""
        return self.facts.layout

    @property
    def nominal(self) -> Vehicle:
        """The car as controllers know it."""
        return self.facts.nominal


def make_env(env_id: str, options: Mapping[str, Any]) -> CarEnv:
    """Make the env of an id; a missing or unknown argument is a TypeError with a short message.

    Args:
        env_id: Id of a registered env.
        options: Arguments of `gym.make`.
    """
    try:
        return gym.make(env_id, **options)
    except TypeError as error:  # of which Gymnasium makes a longer one
        raise TypeError(str(error).partition(" was raised from the environment")[0]) from None


def get_env_facts(env: AnyEnv | EnvView) -> EnvFacts:
    """Collect the facts of an env, a vector env, a stable-baselines3 `VecEnv` or an `EnvView`.

    Every wrapper must be known to keep observations and actions, or have `transparent = True` on
    itself or its class. A subclass that overrides how it steps, observes or acts sets it anew.
    Raises ValueError for another wrapper, or rows with different nominal cars or limits.
    """
    try:
        return env.facts if isinstance(env, EnvView) else _collect_facts(env)
    except AttributeError as error:
        made_by = "an agent is built for an env as of gym.make('sideslip/YawVision-v0')"
        raise TypeError(f"{made_by}, got {short_repr(env)}") from error


def _collect_facts(env: Any) -> EnvFacts:
    base: Any = env.unwrapped
    if isinstance(env, VectorEnv):
        layout, width = get_layout(env), base.single_action_space.shape[0]
    else:
        has_layout = isinstance(env, gym.Env)
        layout = env.get_wrapper_attr("layout") if has_layout else _get_common(base, "layout")
        width = base.action_space.shape[0]
        _check_wrappers(env, layout)
    cars = zip(*(_get_row_values(base, name) for name in ("nominal", "vehicle")), strict=True)
    designs = [(nominal, car.yaw_moment_limit, car.steering_authority) for nominal, car in cars]
    design = _check_common("nominal vehicle, or other limits", designs)
    period, kind = (_get_common(base, name) for name in ("control_period", "reference"))
    rates, plants = [], set()
    for config in list_configs(env):
        x, tyres = config.scenario, config.world.tyres or config.scenario.tyres
        rates.append(config.world.moment_rate)
        plants.add(PlantKind(tyres, x.small_angle, x.roll, x.lags, config.yaw_first))
    rate = _check_common("moment_rate", rates)
    return EnvFacts(layout, *design, period, kind, width, rate, frozenset(plants))


def list_configs(env: AnyEnv) -> Sequence[EnvConfig]:
    """List the configurations of an env, one for all rows or one for each sub-environment."""
    base: Any = env.unwrapped
    if hasattr(base, "row_configs"):
        return list(base.row_configs)
    return [base.config] if hasattr(base, "config") else base.get_attr("config")


def _iterate_wrappers(env: Any) -> Iterator[Any]:
    """Iterate over the wrappers from the outermost in, and those of sub-environments."""
    inner = vars(env)
    if isinstance(env, gym.Wrapper | VectorWrapper) or "venv" in inner:
        yield env
        yield from _iterate_wrappers(inner["venv"] if "venv" in inner else env.env)  # noqa: SIM401
    for child in (*inner.get("envs", ()), *filter(None, [inner.get("vector_env")])):
        yield from _iterate_wrappers(child)


def _is_transparent(wrapper: object) -> bool:
    """Return whether a wrapper is known, or declared, to keep observations and actions."""
    if "transparent" in vars(wrapper):
        return vars(wrapper)["transparent"] is True
    for base_class in type(wrapper).__mro__:
        if "transparent" in vars(base_class):
            return vars(base_class)["transparent"] is True
        package = base_class.__module__.partition(".")[0]
        if base_class.__name__ in _TRANSPARENT.get(package, "").split():
            return not getattr(wrapper, "norm_obs", False)  # a VecNormalize may change them
        if not _CHANGES.isdisjoint(vars(base_class)):
            return False
    return False


def _check_wrappers(env: Any, layout: tuple[ObservationEntry, ...]) -> None:
    """Raise ValueError, with its name, for a wrapper that is not known to be transparent."""
    wrong = [type(layer).__name__ for layer in _iterate_wrappers(env) if not _is_transparent(layer)]
    base = env.unwrapped
    # sub-environments in other processes: their wrappers show in the spaces alone
    if {"layout", "envs", "vector_env"}.isdisjoint(dir(base)):
        single = "single_" if isinstance(env, VectorEnv) else ""
        spaces = [getattr(base, f"{single}{name}_space") for name in ("observation", "action")]
        shares = gym.spaces.Box(-1.0, 1.0, spaces[1].shape, np.float32)
        if spaces != [make_space(layout), shares]:
            wrong.append(f"a wrapper within {type(base).__name__}")
    if wrong:
        raise ValueError(
            f"{wrong[0]} may change observations or actions, which an agent reads and gives by "
            "name and unit: build and drive the agent on the env inside of it; one that changes "
            "neither says so by transparent = True, on it or in its class"
        )


def get_layout(env: CarVectorEnv) -> tuple[ObservationEntry, ...]:
    """Read the layout of the outermost layer that has one, else that of the sub-environments."""
    layer: Any = env
    while "layout" not in vars(layer) and isinstance(layer, VectorWrapper):
        layer = layer.env
    layout = tuple(_get_common(layer, "layout"))
    _check_wrappers(env, layout)
    return layout


def _get_row_values(base: Any, name: str) -> Sequence[Any]:
    """Return an attribute of each row: the vector env's own sequence, or its sub-environments'."""
    if isinstance(base, gym.Env):
        return [getattr(base, name)]
    return list(getattr(base, name) if hasattr(base, name) else base.get_attr(name))


def _get_common(base: Any, name: str) -> Any:
    """Return an attribute that all rows share."""
    if hasattr(base, name):
        return getattr(base, name)
    return _check_common(name, base.get_attr(name))


def _check_common(what: str, rows: Sequence[_Value]) -> _Value:
    """Return what all rows have; ValueError where they differ."""
    for i, row in enumerate(rows):
        if row != rows[0]:
            raise ValueError(
                f"row {i} of the vector env has another {what} than row 0, and rows share one "
                "design: make an agent for each kind of car"
            )
    return rows[0]
