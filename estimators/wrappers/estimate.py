"""EstimateObservation: an estimator's view beside, or instead of, the raw observation."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker

from ...envs.task.observation import Entry
from ...envs.vehicle.vehicle import Vehicle, vehicle_from
from ..estimator import Estimator
from ..make import make_estimator
from .kernel import observe_entry
from .outputs import BETA, outputs_of
from .truth import as_built, tell_stiffness

_MAY_STAND_BETWEEN = (PassiveEnvChecker, OrderEnforcing)
# stable-baselines3's make_vec_env and rl-zoo put it directly around the environment. It only keeps
# count, and is known by name: this module loads nothing of theirs.
_MONITOR = ("stable_baselines3.common.monitor", "Monitor")
TRUTH = "truth"  # in place of a vehicle: the one that is driven
_OFFERED = ("rows", "ticks_done", "packets", "delivered", "slow_sensors", "nominal", "layout")


class EstimateObservation(
    gym.Wrapper[npt.NDArray[np.float32], Any, npt.NDArray[np.float32], Any], RecordConstructorArgs
):
    """Runs an estimator on the car's record and appends what it says to the observation.

    It must be the innermost wrapper: the estimator sees every tick of every step. Others of its
    kind may be stacked, each with its own `name`; stable-baselines3's `Monitor` may be inside.

    estimator: a name of `make_estimator`; None: `usual_estimator` of the env's sensors. outputs:
    states to append, each as `<state>_hat`, then, if `std`, each one's standard deviation as
    `<state>_std`. replace: the observation is these alone. vehicle: what the estimator is told (a
    preset, a mapping; default the env's nominal; "truth": the true car of each episode, as it is at
    the reset). options: of `make_estimator`. name: put before every name as `<name>_`.

    `info` gains `beta_hat` and `beta_std` where the estimator has beta and, if beta or gamma is
    among the outputs, `nees`: their normalised estimation error squared, divided by their number.
    `layout` describes the whole observation; `estimator` is the estimator at work.

    Raises TypeError if it is not the innermost wrapper or the env has no record; ValueError for an
    unknown output, or where names would stand twice.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        estimator: str | None = None,
        outputs: Sequence[str] = ("beta", "gamma"),
        std: bool = True,
        replace: bool = False,
        vehicle: str | Mapping[str, Any] | Vehicle | None = None,
        options: Mapping[str, Any] | None = None,
        name: str | None = None,
    ) -> None:
        self._base = base_of(env)
        if estimator is None:
            estimator = usual_estimator(self._base.slow_sensors)
        car = vehicle.to_dict() if isinstance(vehicle, Vehicle) else vehicle
        RecordConstructorArgs.__init__(
            self,
            estimator=estimator,
            outputs=list(outputs),
            std=bool(std),
            replace=bool(replace),
            vehicle=dict(car) if isinstance(car, Mapping) else car,
            options=dict(options or {}),
            name=name,
        )
        gym.Wrapper.__init__(self, env)
        self._kind, self._options = estimator, dict(options or {})
        self._truth = isinstance(vehicle, str) and vehicle == TRUTH
        self._vehicle = None if vehicle is None or self._truth else vehicle_from(vehicle)
        self._told: Any = None
        self.estimator: Estimator = self._current_estimator()
        inner: tuple[Entry, ...] = () if replace else env.get_wrapper_attr("layout")
        self._says = outputs_of(estimator, self.estimator.names, outputs, std, name, inner)
        self.layout: tuple[Entry, ...] = self._says.layout
        low, high = self._says.bounds
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float32)
        self._width = len(self.layout)
        self._said = np.zeros(3)

    def _current_estimator(self) -> Estimator:
        """The estimator for what the env tells now; the one at hand where nothing changed."""
        base = self._base
        vehicle = base.nominal if self._vehicle is None else self._vehicle
        if self._truth:
            vehicle = base.vehicle
            if self._told is not None:
                vehicle = as_built(self.estimator, self._told[0], vehicle)
        speed = getattr(base, "held_speed", None)
        clocks = {name: (s.period, s.delays, s.jitter) for name, s in base.slow_sensors.items()}
        told = vehicle, clocks, speed
        if told != self._told:
            self.estimator = make_estimator(
                self._kind,
                vehicle=vehicle,
                sensors=base.slow_sensors,
                dt=base.dt,
                speed=speed,
                **self._options,
            )
            self._told = told
        if self._truth:
            tell_stiffness(self.estimator, base.vehicle)
        return self.estimator

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Reset the env, then the estimator with this episode's clocks, and take tick 0."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._current_estimator().reset(self._base.slow_sensors)
        return self._observed(obs, info), info

    def step(self, action: Any) -> tuple[npt.NDArray[np.float32], Any, bool, bool, dict[str, Any]]:
        """One env-step, whose record the estimator takes before the observation is made."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._observed(obs, info), reward, terminated, truncated, info

    def get_state(self) -> dict[str, Any]:
        """A snapshot of the env and the estimator that `set_state` continues from."""
        inner = self.env.get_wrapper_attr("get_state")()
        return {"env": inner, "estimator": self.estimator.get_state()}

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Go back to a snapshot of this env or of one built with the same arguments."""
        self.env.get_wrapper_attr("set_state")(snapshot["env"])
        self._current_estimator().set_state(snapshot["estimator"])

    def _observed(
        self, obs: npt.NDArray[np.float32], info: dict[str, Any]
    ) -> npt.NDArray[np.float32]:
        base, estimator, says = self._base, self.estimator, self._says
        out, said, rows, done = np.empty(self._width, np.float32), self._said, base.ticks_done, 0
        while True:
            done = observe_entry()(
                estimator.filters,
                estimator.gains,
                base.rows,
                rows,
                base.packets,
                base.delivered,
                done,
                obs,
                says.kept,
                says.plan,
                says.limits,
                info["beta"],
                info["gamma"],
                out,
                said,
            )
            if done == rows:
                break
            estimator.design_missing()
        values = said.tolist()
        for key, place in says.keys:
            info[key] = values[place]
            if place == BETA:
                base.annotate(**{key: values[place]})
        return out


def usual_estimator(slow_sensors: Iterable[str]) -> str:
    """The estimator where none is named: `dakf` where there is a GPS, else `exact-kf`."""
    return "dakf" if "gps" in slow_sensors else "exact-kf"


def base_of(env: gym.Env[Any, Any]) -> Any:
    """The base env; TypeError if anything that may hide ticks from the estimator is in between."""
    layer = env
    while isinstance(layer, gym.Wrapper):
        kind = type(layer)
        known = isinstance(layer, (*_MAY_STAND_BETWEEN, EstimateObservation))
        if not known and (kind.__module__, kind.__name__) != _MONITOR:
            raise TypeError(
                "EstimateObservation must be the innermost wrapper, directly around the "
                f"environment; inside it is {kind.__name__}"
            )
        layer = layer.env
    missing = [name for name in _OFFERED if not hasattr(layer, name)]
    if missing:
        raise TypeError(
            f"EstimateObservation reads the record of a sideslip environment; "
            f"{type(layer).__name__} has no {', '.join(missing)}"
        )
    return layer
