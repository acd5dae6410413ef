"""Stable-baselines3's `VecEnv` over the native vector env: one call for all rows."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NoReturn, cast

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode, VectorWrapper

from ..envs.numerics import require_extra
from ..envs.task import GAMMA_SCALE, STEER_SCALE, ObservationEntry, make_info, make_space
from ..envs.vector import StabilityVectorEnv
from ..envs.vehicle.dynamics import Motion
from ..estimators.vector import estimate as vector_estimate
from ..estimators.wrappers import estimate as single_estimate
from ..estimators.wrappers import truth as single_truth
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
    "layout", "control_period", "reference", "dt", "setting", "spec", "render_mode",
    "metadata",
)  # fmt: skip
_SPACES = ("observation_space", "action_space")
_OTHER_NAMES = {"config": "row_configs"}  # of what the vector env has one of all rows too
_METHODS = ("reset", "get_wrapper_attr", "has_wrapper_attr", "set_wrapper_attr")
_SCALES = {  # by unit, what is much in a drive; other units keep their numbers
    "rad": STEER_SCALE, "rad/s": GAMMA_SCALE, "m/s": 10.0, "m/s2": 1.0, "m": 1.0, "N": 500.0,
    "N m": 100.0, "1/m": 0.01,
}  # fmt: skip
_WIDE_SCALES = {"gps_X": 100.0, "gps_Y": 100.0}  # m, positions on a map
_TWINS: dict[type, type] = {
    single_estimate.EstimateObservation: vector_estimate.EstimateObservation,
    single_truth.TruthObservation: vector_estimate.TruthObservation,
}


class _VecEnvRow:
    """Row i of a vector env: `_ROW_ATTRIBUTES` and the like, and values that are set on it."""

    def __init__(self, env: CarVectorEnv, i: int) -> None:
        self._env, self._i = env, i
        self._set: dict[str, object] = {}

        self._layers = [env]  # from the outermost wrapper to the bare vector env
        while isinstance(self._layers[-1], VectorWrapper):
            self._layers.append(self._layers[-1].env)

    def get_wrapper_attr(self, name: str) -> Any:
        """Get an attribute of this row from the outermost layer that has it."""
        if name in self._set:
            return self._set[name]
        if name in _METHODS:
            return getattr(self, name)
        attribute = f"single_{name}" if name in _SPACES else _OTHER_NAMES.get(name, name)
        if name in (*_ROW_ATTRIBUTES, *_SHARED_ATTRIBUTES, *_SPACES):
            for layer in self._layers:
                if attribute in vars(layer) or hasattr(type(layer), attribute):
                    value = getattr(layer, attribute)
                    value = value[self._i] if name in _ROW_ATTRIBUTES else value
                    return Motion(*value.tolist()) if name == "motion" else value
        known = (*_ROW_ATTRIBUTES, *_SHARED_ATTRIBUTES, *_SPACES, *_METHODS, *self._set)
        raise AttributeError(f"a row of a vector env has {', '.join(known)}; not {name!r}")

    def has_wrapper_attr(self, name: str) -> bool:
        """Return whether `get_wrapper_attr` finds an attribute."""
        with suppress(AttributeError):
            self.get_wrapper_attr(name)
            return True
        return False

    def set_wrapper_attr(self, name: str, value: object, **_: object) -> None:
        """Set a value beside the env, under a name that the env does not have."""
        if name not in self._set and self.has_wrapper_attr(name):
            text = "options of reset (`set_options`) change the scenario, vehicle, friction, state"
            error = f"{name!r} is the environment's and is not set from outside"
            raise AttributeError(f"{error}; {text} and duration")
        self._set[name] = value

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode in this row alone; return observation (k,) and info."""
        mask = np.arange(self._env.num_envs) == self._i
        seeds: Any = [seed if is_row else None for is_row in mask]
        more = {name: [value] * len(mask) for name, value in (options or {}).items()}
        obs, infos = self._env.reset(seed=seeds, options={**more, "reset_mask": mask})
        base: Any = self._env.unwrapped
        (info,) = _split_infos(infos, [self._i])
        return obs[self._i], make_info(base.engine.arrays.reports[self._i].tolist()) | info

    def is_wrapped(self, wrapper_class: type) -> bool:
        """Return whether a layer has this class, or is the vector twin of it."""
        wanted = _TWINS.get(wrapper_class, wrapper_class)
        return any(isinstance(layer, wanted) for layer in self._layers)


class _EmptyInfo(dict[str, object]):
    """The info of a row where nothing ended: empty, one for all rows, and closed."""

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise TypeError(
            "the info of a row whose episode goes on is one empty dict that all rows share; put "
            "another dict in its place in the list instead of writing into it"
        )

    __setitem__ = update = setdefault = __ior__ = _refuse

    def __reduce__(self) -> tuple[object, ...]:  # a copy is an ordinary dict
        return dict, ()


EMPTY_INFO = _EmptyInfo()


class _NativeVecEnv(VecEnv):
    """stable-baselines3's `VecEnv` over a `StabilityVectorEnv`, wrapped or bare.

    It equals its `DummyVecEnv` around single environments with the same seeds, bit for bit, but for
    `infos`: where no episode ends it holds one empty dict that all rows share (`EMPTY_INFO`).
    `set_options` takes the options of a single env's `reset`, for all rows or a list of them.
    """

    def __init__(self, vector_env: CarVectorEnv) -> None:
        mode = vector_env.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            text = "stable-baselines3 expects rows to be reset in the step that ends them: build"
            raise ValueError(f"{text} the vector env with autoreset_mode='SameStep', not {mode}")
        self.vector_env, self._base = vector_env, cast("StabilityVectorEnv", vector_env.unwrapped)
        self._rows = [_VecEnvRow(vector_env, i) for i in range(vector_env.num_envs)]
        self._actions: Any = None
        spaces = vector_env.single_observation_space, vector_env.single_action_space
        super().__init__(vector_env.num_envs, *spaces)
        self.metadata = dict(vector_env.metadata)

    @property
    def spec(self) -> Any:
        """Spec of the vector env, without its wrappers."""
        return self.vector_env.spec

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
        row_infos: list[dict[str, Any]] = [EMPTY_INFO] * self.num_envs
        if "final_obs" in infos:
            ended = np.flatnonzero(dones).tolist()
            finals = _split_infos(infos["final_info"], ended)
            for i, info in zip(ended, finals, strict=True):
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
        return [row.get_wrapper_attr(attr_name) for row in self._get_rows(indices)]

    def set_attr(self, attr_name: str, value: object, indices: _Indices = None) -> None:
        """Store a value beside the env for each row; AttributeError where the name is the env's."""
        for row in self._get_rows(indices):
            row.set_wrapper_attr(attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: _Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a row's `reset` or a method of wrapped attributes; AttributeError without one."""
        chosen = [row.get_wrapper_attr(method_name) for row in self._get_rows(indices)]
        return [method(*method_args, **method_kwargs) for method in chosen]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: _Indices = None
    ) -> list[bool]:
        """Return for each row whether it has a wrapper's class or its vector twin."""
        return [row.is_wrapped(wrapper_class) for row in self._get_rows(indices)]

    def _get_rows(self, indices: _Indices) -> list[_VecEnvRow]:
        return [self._rows[i] for i in self._get_indices(indices)]


def get_scales(layout: Sequence[ObservationEntry]) -> npt.NDArray[np.float32]:
    """Get the fixed scale of each entry of an observation.

    Args:
        layout: Entries of the observation.

    Returns:
        Scales in the entries' units, shape (k,).
    """
    scales = [_WIDE_SCALES.get(name, _SCALES.get(unit, 1.0)) for name, unit, *_ in layout]
    return np.array(scales, np.float32)


def scale_layout(layout: Sequence[ObservationEntry]) -> tuple[ObservationEntry, ...]:
    """Divide the bounds of an observation's entries by their scales.

    Args:
        layout: Entries in their units.
    """
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
    `DummyVecEnv` of single environments with the same seeds. Its `infos` hold one empty dict for
    all rows but those whose episode ends.

    Args:
        env_id: Id of an env with a native vector env.
        num_envs: Number of rows.
        seed: Seed of row 0; row i gets seed + i at the first reset.
        estimator: Name of an estimator, or arguments of `EstimateObservation`.
        env_kwargs: Arguments of the environment.
        monitor_file: CSV file of episodes.
        info_keywords: Keys of the last step's info that go into that file.
        wrapper_class: Wrapper for the vector env, applied outside the estimator's wrapper; its
            result becomes the `VecEnv`.
        scaled: Whether observations and rewards are scaled; no controller reads such observations.

    Returns:
        `VecEnv` that monitors episodes.
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
        env_id: Id of an env with a native vector env.
        num_envs: Number of rows.
        estimator: Name of an estimator, or arguments of `EstimateObservation`.
        env_kwargs: Arguments of the environment.

    Returns:
        Vector env, wrapped if there is an estimator.

    Raises:
        ValueError: The id has no native vector env.
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
    return vector_estimate.EstimateObservation(env, **estimator)


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
