"""Stable-baselines3's `VecEnv` over the native vector env: one call for all rows.

Args:
    layout: Entries of an observation, in their units.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode, VectorWrapper

from ..envs.numerics import require_extra
from ..envs.task import GAMMA_SCALE, STEER_SCALE, ObservationEntry, make_info, make_space
from ..envs.vector import StabilityVectorEnv
from ..envs.vehicle.dynamics import Motion
from ..estimators.vector.estimate import EstimateObservation
from .env_info import CarVectorEnv, get_layout

with require_extra("train", "training needs torch and stable-baselines3"):
    from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

Observations = npt.NDArray[np.float32]
_Indices = int | Iterable[int] | None
_Wrapping = Callable[[CarVectorEnv], CarVectorEnv]
_ROW_ATTRIBUTES = (  # each is a sequence in the vector env, with an item for each row
    "vehicle", "nominal", "scenario", "record", "held_speed", "slow_sensors", "motion",
    "estimator", "np_random", "np_random_seed", "config",
)  # fmt: skip
_SHARED_ATTRIBUTES = (  # each is the same for all rows
    "layout", "control_period", "reference", "dt", "setting", "spec", "render_mode", "metadata",
)  # fmt: skip
_SPACES = ("observation_space", "action_space")
_OTHER_NAMES = {  # of a row, in the vector env, where it has the same name of all rows
    "config": "row_configs", **{name: f"single_{name}" for name in _SPACES}
}  # fmt: skip
_SCALES = {  # by unit, what is much in a drive; other units keep their numbers
    "rad": STEER_SCALE, "rad/s": GAMMA_SCALE, "m/s": 10.0, "m/s2": 1.0, "m": 1.0, "N": 500.0,
    "N m": 100.0, "1/m": 0.01,
}  # fmt: skip
_WIDE_SCALES = {"gps_X": 100.0, "gps_Y": 100.0}  # m, positions on a map


class _NativeVecEnv(VecEnv):
    """stable-baselines3's `VecEnv` over a `StabilityVectorEnv`, wrapped or bare.

    It equals its `DummyVecEnv` around single environments with the same seeds, bit for bit, but for
    `infos`: where no episode ends they are empty. Rows have no methods, and nothing is set on them.
    `set_options` takes the options of a single env's `reset`, for all rows or a list of them.
    """

    def __init__(self, vector_env: CarVectorEnv) -> None:
        mode = vector_env.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"a VecEnv resets its rows: autoreset_mode='SameStep', not {mode}")
        self.vector_env, self._base = vector_env, cast("StabilityVectorEnv", vector_env.unwrapped)
        self._layers = [vector_env]  # from the outermost wrapper to the bare vector env
        while isinstance(self._layers[-1], VectorWrapper):
            self._layers.append(self._layers[-1].env)
        self._actions: Any = None
        spaces = vector_env.single_observation_space, vector_env.single_action_space
        super().__init__(vector_env.num_envs, *spaces)
        self.metadata, self.spec = dict(vector_env.metadata), vector_env.spec

    def reset(self) -> Observations:
        """Start an episode in every row, with the seeds and options that were set for it."""
        seeds: Any = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        names = dict.fromkeys(name for row_options in self._options for name in row_options)
        options = {name: [row.get(name) for row in self._options] for name in names} or None
        obs, infos = self.vector_env.reset(seed=seeds, options=options)
        self._reset_seeds()
        self._reset_options()
        self._store_infos(range(self.num_envs), infos)
        return np.asarray(obs)

    def step_async(self, actions: npt.NDArray[np.floating]) -> None:
        """Store the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Apply each row's action for one control period."""
        actions, self._actions = self._actions, None
        obs, rewards, terminated, truncated, infos = self.vector_env.step(actions)
        dones = terminated | truncated
        row_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if "final_obs" in infos:
            ended = np.flatnonzero(dones).tolist()
            for i, info in zip(ended, _split_infos(infos["final_info"], ended), strict=True):
                info["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
                info["terminal_observation"] = infos["final_obs"][i]
                row_infos[i] = info
            self._store_infos(ended, infos)
        return obs, rewards.astype(np.float32), dones, row_infos

    def _store_infos(self, rows: Sequence[int], infos: Mapping[str, Any]) -> None:
        """Store the infos that the resets of these rows returned."""
        reset_infos = {key: value for key, value in infos.items() if "final_" not in key}
        for i, info in zip(rows, _split_infos(reset_infos, rows), strict=True):
            self.reset_infos[i] = make_info(self._base.engine.arrays.reports[i].tolist()) | info

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """Get a frame of each row, with render_mode="rgb_array"."""
        return cast("Any", self.vector_env.render()) or ()

    def render(self, mode: str | None = None) -> npt.NDArray[np.uint8] | None:
        """Render all rows as one frame (height, width, 3); None for "human"."""
        return None if self.render_mode == "human" else super().render(mode)

    def close(self) -> None:
        """Close the vector env."""
        self.vector_env.close()

    def get_attr(self, attr_name: str, indices: _Indices = None) -> list[Any]:
        """Get what a single env has of each row; AttributeError where rows do not have it."""
        rows = self._get_indices(indices)
        attribute = _OTHER_NAMES.get(attr_name, attr_name)
        known = (*_ROW_ATTRIBUTES, *_SHARED_ATTRIBUTES, *_SPACES)
        for layer in self._layers if attr_name in known else ():
            if attribute in vars(layer) or hasattr(type(layer), attribute):
                value: Any = getattr(layer, attribute)
                if attr_name == "motion":
                    return [Motion(*value[i].tolist()) for i in rows]
                return [value[i] if attr_name in _ROW_ATTRIBUTES else value for i in rows]
        raise AttributeError(f"a row of a vector env has {', '.join(known)}; not {attr_name!r}")

    def set_attr(self, attr_name: str, value: object, indices: _Indices = None) -> None:
        """Raise AttributeError: options of reset change what may be changed."""
        text = "options of reset (`set_options`) change the scenario, vehicle, friction, state and"
        raise AttributeError(f"{attr_name!r} is not set from outside; {text} duration")

    def env_method(
        self, method_name: str, *method_args: Any, indices: _Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Raise AttributeError: rows of a vector env have no methods."""
        raise AttributeError(f"a row of a vector env has no method {method_name!r}: see get_attr")

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: _Indices = None
    ) -> list[bool]:
        """Return for each row whether a layer of the vector env has this class."""
        is_wrapped = any(isinstance(layer, wrapper_class) for layer in self._layers)
        return [is_wrapped for _ in self._get_indices(indices)]


def get_scales(layout: Sequence[ObservationEntry]) -> npt.NDArray[np.float32]:
    """Get the fixed scale of each entry of an observation, in its unit, shape (k,)."""
    scales = [_WIDE_SCALES.get(name, _SCALES.get(unit, 1.0)) for name, unit, *_ in layout]
    return np.array(scales, np.float32)


def scale_layout(layout: Sequence[ObservationEntry]) -> tuple[ObservationEntry, ...]:
    """Divide the bounds of an observation's entries by their scales."""
    rows = zip(layout, get_scales(layout).tolist(), strict=True)
    return tuple(ObservationEntry(name, "-", a / s, b / s) for (name, _, a, b), s in rows)


class ScaledVecEnv(VecEnvWrapper):
    """Observations over fixed scales, such as 0.05 rad, and rewards per second.

    Both are of order one, as stable-baselines3's defaults expect. The monitor inside and `infos`
    have the costs as they are.

    Args:
        venv: Monitor around the bridge.
        layout: Entries of its observation.
    """

    def __init__(self, venv: VecEnv, layout: Sequence[ObservationEntry]) -> None:
        super().__init__(venv, make_space(scale_layout(layout)))
        ticks, dt = (venv.get_attr(name)[0] for name in ("control_period", "dt"))
        self._scales, self._period = get_scales(layout), np.float32(ticks * dt)

    def reset(self) -> Observations:
        """Reset the inner env and scale its observations."""
        return np.asarray(self.venv.reset(), np.float32) / self._scales

    def step_wait(self) -> VecEnvStepReturn:
        """Step the inner env and scale its observations, last ones too, and rewards."""
        obs, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones).tolist():
            infos[i]["terminal_observation"] = infos[i]["terminal_observation"] / self._scales
        return np.asarray(obs) / self._scales, rewards / self._period, dones, infos


def make_vec_env(
    env_id: str, num_envs: int = 1, seed: int | None = None,
    estimator: str | Mapping[str, object] | None = None,
    env_kwargs: Mapping[str, object] | None = None, monitor_file: str | None = None,
    info_keywords: Sequence[str] = (), wrapper_class: _Wrapping | None = None, scaled: bool = True,
) -> VecMonitor | ScaledVecEnv:  # fmt: skip
    """Make stable-baselines3's `VecEnv` on the native vector env, like its function of this name.

    Observations and rewards are those of `ScaledVecEnv`. With `scaled=False` it has the bits of a
    `DummyVecEnv` of single environments with the same seeds. Its `infos` are empty but for rows
    whose episode ends.

    Args:
        env_id: Id of an env with a native vector env.
        num_envs: Number of rows.
        seed: Seed of row 0; row i gets seed + i at the first reset.
        estimator: Name of an estimator, or arguments of `EstimateObservation`.
        env_kwargs: Arguments of the environment.
        monitor_file: CSV file of episodes.
        info_keywords: Keys of the last step's info that go into that file.
        wrapper_class: Wrapper outside the estimator's; its result becomes the `VecEnv`.
        scaled: Whether observations and rewards are scaled; no controller reads such observations.
    """
    env = make_native_env(env_id, num_envs, estimator, env_kwargs)
    bridge = _NativeVecEnv(wrapper_class(env) if wrapper_class else env)
    bridge.action_space.seed(seed)
    bridge.seed(seed)
    monitor = VecMonitor(bridge, monitor_file, tuple(info_keywords))
    if not scaled:
        return monitor
    layout = get_layout(bridge.vector_env)
    if (len(layout),) != bridge.observation_space.shape:
        shapes = f"{bridge.observation_space.shape} entries and the layout {len(layout)}"
        raise ValueError(f"observations have {shapes}: scaled=False leaves them alone")
    return ScaledVecEnv(monitor, layout)


def make_native_env(
    env_id: str, num_envs: int, estimator: str | Mapping[str, object] | None = None,
    env_kwargs: Mapping[str, object] | None = None,
) -> CarVectorEnv:  # fmt: skip
    """Make the vector env that `make_vec_env` bridges, with its estimator around it.

    Args:
        env_id: Id of an env with a native vector env; ValueError without one.
        num_envs: Number of rows.
        estimator: Name of an estimator, or arguments of `EstimateObservation`.
        env_kwargs: Arguments of the environment.
    """
    entry = gym.spec(env_id).vector_entry_point
    kind = load_env_creator(entry) if isinstance(entry, str) else entry
    if not (isinstance(kind, type) and issubclass(kind, StabilityVectorEnv)):
        text = f"{env_id} has no native vector env of this package; for single environments there"
        raise ValueError(f"{text} is stable_baselines3.common.env_util.make_vec_env")
    arguments: dict[str, Any] = {"autoreset_mode": "SameStep", "info": "ends", **(env_kwargs or {})}
    env: CarVectorEnv = gym.make_vec(env_id, num_envs=num_envs, **arguments)
    if estimator is None:
        return env
    estimator = estimator if isinstance(estimator, Mapping) else {"estimator": estimator}
    return EstimateObservation(env, **estimator)


def _split_infos(infos: Mapping[str, Any], rows: Sequence[int]) -> list[dict[str, Any]]:
    """Split a vector env's infos of some rows into the single envs' infos."""
    singles: list[dict[str, Any]] = [{} for _ in rows]
    for key, column in infos.items():
        if not key.startswith("_"):
            values, is_present = column[rows].tolist(), infos[f"_{key}"][rows].tolist()
            for info, value, is_set in zip(singles, values, is_present, strict=True):
                if is_set:
                    info[key] = value
    return singles
