"""EstimateObservation: an estimator's states beside, or instead of, the raw observation."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from ...envs.task.observation import ObservationEntry, make_space
from ...envs.vehicle.vehicles import VehicleSource
from ..estimator import Estimator
from ..learned.correction import LearnedEstimator
from .arguments import AnyEstimator, Arguments, EstimatorSource, EstimatorSpec, make_spec
from .kernel import compile_observe
from .outputs import BETA, STD, Outputs, make_outputs, make_title, write_outputs
from .truth import choose_vehicle, set_stiffness

_ALLOWED_WRAPPERS = (PassiveEnvChecker, OrderEnforcing, TimeLimit)
# stable-baselines3's make_vec_env and rl-zoo put it directly around the environment. It only counts
# and is known by name: this module loads nothing of theirs.
_MONITOR = ("stable_baselines3.common.monitor", "Monitor")
_BASE_MEMBERS = (
    *("rows", "ticks_done", "packets", "delivered", "slow_sensors", "nominal", "layout", "dt"),
    "annotate",
)


class EstimateObservation(
    gym.Wrapper[npt.NDArray[np.float32], Any, npt.NDArray[np.float32], Any], RecordConstructorArgs
):
    """Runs an estimator on the car's record and appends its states to the observation.

    It must be the innermost wrapper: the estimator sees every tick of every step. Others of its
    class may be stacked, each with its own `name`; `TimeLimit` and stable-baselines3's `Monitor`
    may be inside.

    `info` gains `beta_hat` and `beta_std` where the estimator has beta and, if beta or gamma is
    among the outputs, `nees`: their normalised estimation error squared, divided by their number.
    An estimate that is not finite is passed on, so that controllers and the env see the failure.
    `layout` describes the whole observation, `outputs` what is appended; `estimator` is the
    estimator at work, around a user's own as a `ForeignEstimator`. In `spec` a factory that can be
    imported stands as its entry point; `spec.to_json()` refuses others and objects with TypeError.

    TypeError says that it is not the innermost wrapper, that the env has no record or that the
    estimator is none. ValueError says that an output is unknown, that names would stand twice, or
    that an object has a vehicle or options.

    >>> import gymnasium as gym
    >>> env = EstimateObservation(gym.make("sideslip/YawVision-v0"), "multirate-kf")
    >>> [entry.name for entry in env.layout[-4:]]
    ['beta_hat', 'gamma_hat', 'beta_std', 'gamma_std']

    See also `make_estimator`, `sideslip.estimators.vector.EstimateObservation` for vector envs and
    `register_estimator`.

    Args:
        env: Environment, or wrappers that may be inside.
        estimator: Name of `make_estimator`, entry point "package.module:Name", `EstimatorFactory`
            or `EstimatorLike` object, which is reset at every episode but hears of no other car.
            None for `choose_estimator` of the env's sensors.
        outputs: States to append, each as `<state>_hat`.
        std: Whether each one's standard deviation is appended as `<state>_std`.
        replace: Whether the observation is these alone.
        vehicle: Vehicle as the estimator believes it to be, a preset or a mapping; None for the
            env's nominal. "truth" is the true car of each episode, as it is at the reset.
        options: Options of `make_estimator`.
        name: Put before every name as `<name>_`.
        **misplaced: Refused; the message names the nearest argument or option.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        estimator: EstimatorSource | None = None,
        outputs: Sequence[str] = ("beta", "gamma"),
        std: bool = True,
        replace: bool = False,
        vehicle: VehicleSource | None = None,
        options: Mapping[str, Any] | None = None,
        name: str | None = None,
        **misplaced: Any,
    ) -> None:
        self._base = find_base_env(env)
        clocks = self._base.slow_sensors
        self._arguments = Arguments(
            estimator, outputs, std, replace, vehicle, options, name, clocks, misplaced
        )
        RecordConstructorArgs.__init__(self, **self._arguments.recorded)
        gym.Wrapper.__init__(self, env)
        self._estimator_spec: EstimatorSpec | None = None
        self.estimator: AnyEstimator = self._update_estimator()
        inner: tuple[ObservationEntry, ...] = () if replace else env.get_wrapper_attr("layout")
        states, label = self.estimator.names, self._arguments.label
        self.outputs: Outputs = make_outputs(label, states, outputs, std, name, inner)
        self.layout: tuple[ObservationEntry, ...] = self.outputs.layout
        self.observation_space = make_space(self.layout)
        self._width, self._title = len(self.layout), make_title(label, name)
        self._summary = np.zeros(3)

    def _update_estimator(self) -> AnyEstimator:
        """Return the estimator for the env's present spec; that at hand where nothing changed."""
        base, arguments, previous = self._base, self._arguments, self._estimator_spec
        spec = make_spec(base)
        if arguments.vehicle is not None:
            spec = spec._replace(vehicle=arguments.vehicle)
        elif arguments.truth:
            car = base.vehicle
            vehicle = (
                car if previous is None else choose_vehicle(self.estimator, previous.vehicle, car)
            )
            spec = spec._replace(vehicle=vehicle)
        if previous is None or spec.design != previous.design:
            self.estimator, self._estimator_spec = arguments.build(spec, base.dt), spec
            self._is_native = isinstance(self.estimator, Estimator) and self.estimator.compiled
        if arguments.truth:
            set_stiffness(self.estimator, base.vehicle)
        return self.estimator

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Reset the env, then the estimator with this episode's clocks, and take tick 0.

        Args:
            seed: Seed of the env.
            options: Options of the env's reset.

        Returns:
            Observation, shape (width,), and info.
        """
        obs, info = self.env.reset(seed=seed, options=options)
        self._update_estimator().reset(self._base.slow_sensors)
        return self._append_estimates(obs, info), info

    def step(self, action: Any) -> tuple[npt.NDArray[np.float32], Any, bool, bool, dict[str, Any]]:
        """Step the env; the estimator takes its record before the observation is made.

        Args:
            action: Action of the env.

        Returns:
            Observation, shape (width,), reward, terminated, truncated and info.
        """
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._append_estimates(obs, info), reward, terminated, truncated, info

    def get_state(self) -> dict[str, Any]:
        """Return a snapshot of the env and the estimator for `set_state`."""
        inner = self.env.get_wrapper_attr("get_state")()
        return {"env": inner, "estimator": self.estimator.get_state()}

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of this env or of one built with the same arguments.

        Args:
            snapshot: Result of `get_state`.
        """
        self.env.get_wrapper_attr("set_state")(snapshot["env"])
        self._update_estimator().set_state(snapshot["estimator"])

    def _append_estimates(
        self, obs: npt.NDArray[np.float32], info: dict[str, Any]
    ) -> npt.NDArray[np.float32]:
        """Process the newest step; return the observation with its outputs, (width,)."""
        base, outputs, summary = self._base, self.outputs, self._summary
        estimator: Any = self.estimator
        inner = None if self._is_native else getattr(estimator, "inner", None)
        out, rows, done = np.empty(self._width, np.float32), base.ticks_done, 0
        record = base.rows, rows, base.packets, base.delivered
        layout_args = outputs.inner, outputs.plan, outputs.limits
        observe_args = obs, *layout_args, info["beta"], info["gamma"], out, summary
        if isinstance(inner, LearnedEstimator):
            memory = inner.base.filters, inner.base.gains
            compile_observe(corrected=True)(*memory, record, inner.memory, inner.net, observe_args)
        elif not self._is_native:
            estimator.step(base.rows[:rows], base.packets[: base.delivered])
            write_outputs(estimator, *observe_args)
        while self._is_native:
            memory = estimator.filters, estimator.gains
            done = compile_observe()(*memory, *record, done, *observe_args)
            if done == rows:  # which a refused action leaves at none
                break
            estimator.design_missing()
        values = summary.tolist()
        for key, index in outputs.keys:
            info[key] = values[index]
            if index == BETA:
                base.annotate(self._title, values[BETA], values[STD])
        return out


def find_base_env(env: gym.Env[Any, Any]) -> Any:
    """Find the base env, with no wrapper in between that may hide ticks from the estimator.

    Args:
        env: Environment, wrapped or not.

    Returns:
        The environment that has the record.

    Raises:
        TypeError: Another wrapper is inside, or the environment has no record.
    """
    layer = env
    while isinstance(layer, gym.Wrapper):
        kind = type(layer)
        is_allowed = isinstance(layer, (*_ALLOWED_WRAPPERS, EstimateObservation))
        if not is_allowed and (kind.__module__, kind.__name__) != _MONITOR:
            raise TypeError(
                "EstimateObservation must be the innermost wrapper, directly around the "
                f"environment; inside it is {kind.__name__}"
            )
        layer = layer.env
    missing = [name for name in _BASE_MEMBERS if not hasattr(layer, name)]
    if missing:
        raise TypeError(
            f"EstimateObservation reads the record of a sideslip environment; "
            f"{type(layer).__name__} has no {', '.join(missing)}"
        )
    return layer
