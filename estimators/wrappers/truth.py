"""TruthObservation: parameters and states of the true car beside the observation."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.utils import RecordConstructorArgs

from ...envs.engine.layout import TRUE_STATE, CarTruth
from ...envs.record import FAST, Array
from ...envs.task import ObservationEntry, make_space
from ...envs.validation import check_choice
from ...envs.vehicle.parameters import Vehicle
from ..core.memory import CAR, GAIN
from ..estimator import Estimator
from ..protocol import ForeignEstimator

_Floats = npt.NDArray[np.float32]
AnyEstimator = Estimator | ForeignEstimator
Readings = TypeVar("Readings", Array, _Floats)
TRUTH = "truth"  # in place of a vehicle: the one that is driven
STIFFNESSES = ("front_stiffness", "rear_stiffness")
_MOTORS = {"motor_left": "-", "motor_right": "-"}
_MAX_PARAMETER = 1e7  # bound of any parameter of a vehicle, SI
_STATES = {
    "beta": ("rad", math.pi), "gamma": ("rad/s", 20.0), "F_d": ("N", _MAX_PARAMETER),
    "N_d": ("N m", _MAX_PARAMETER), "phi": ("rad", math.pi), "phi_rate": ("rad/s", 100.0),
    "friction_factor": ("-", 100.0),
}  # fmt: skip


def calibrate(readings: Readings, calibration: Readings) -> Readings:
    """Correct readings by what is told of their sensors: true values but for noise.

    Args:
        readings: Readings, shape (..., k).
        calibration: Offset and scale of each, shape (2, k), or (N, 2, k) of N cars.
    """
    return (readings - calibration[..., 0, :]) / calibration[..., 1, :]


class TruthEntries:
    """Entries of true parameters and states behind those of an observation, of one car or several.

    Args:
        parameters: Parameters of a `Vehicle` or motors of `CarTruth`, each as `true_<parameter>`.
        states: States of a `TrueState`, each as `<state>_hat`.
        inner: Entries of the observation; ValueError for a name that is unknown or twice there.

    Attributes:
        layout: All entries.
        columns: Fast columns of the k readings in the observation.
    """

    def __init__(
        self, parameters: Sequence[str], states: Sequence[str], inner: Sequence[ObservationEntry]
    ) -> None:
        self.parameters, self.states = tuple(parameters), tuple(states)
        fields = {field.name: field.metadata.get("unit") for field in dataclasses.fields(Vehicle)}
        units = {name: unit for name, unit in fields.items() if unit is not None} | _MOTORS
        entries = list(inner)
        for name in parameters:
            check_choice("parameter of a vehicle", name, units)
            limits = -_MAX_PARAMETER, _MAX_PARAMETER
            entries.append(ObservationEntry(f"true_{name}", units[name], *limits))
        for name in states:
            check_choice("true state", name, _STATES)
            unit, limit = _STATES[name]
            entries.append(ObservationEntry(f"{name}_hat", unit, -limit, limit))
        names = [entry.name for entry in entries]
        if duplicates := ", ".join(sorted({name for name in names if names.count(name) > 1})):
            raise ValueError(f"{duplicates} would stand twice in the observation")
        self.layout = tuple(entries)
        stems = [re.sub(r"_(mean|\d+)$", "", entry.name) for entry in inner]
        self._places = [i for i, stem in enumerate(stems) if stem in FAST._fields]
        self.columns = [FAST._fields.index(stems[i]) for i in self._places]
        self._limits = np.array([_STATES[name][1] for name in states])
        self._state_columns = [getattr(TRUE_STATE, name) for name in states]

    def read(self, truth: CarTruth) -> tuple[_Floats, _Floats]:
        """Read parameters of a car (SI units), and offset and scale of its readings, shape (2, k).

        Args:
            truth: What is told of the episode.
        """
        sources = {name: truth if name in _MOTORS else truth.vehicle for name in self.parameters}
        values = [getattr(source, name) for name, source in sources.items()]
        calibration = truth.calibration[:, self.columns].astype(np.float32)
        return np.array(values, np.float32), calibration

    def append(
        self, obs: _Floats, values: _Floats, calibration: _Floats, true_state: Array | None
    ) -> _Floats:
        """Append parameters and states to an observation, and calibrate its readings.

        Args:
            obs: Observation, shape (..., inner).
            values: Parameters at the reset, shape (..., len(parameters)).
            calibration: Offset and scale of the readings, shape (..., 2, k).
            true_state: States, shape (..., len(TrueState)); None without entries of states.
        """
        parts = [obs, values]
        if true_state is not None:
            if "friction" in self.parameters:  # what has changed since the reset is of the state
                parts[1] = values.copy()
                factor = true_state[..., TRUE_STATE.friction_factor].astype(np.float32)
                parts[1][..., self.parameters.index("friction")] *= factor
            states = true_state[..., self._state_columns].clip(-self._limits, self._limits)
            parts.append(states.astype(np.float32))
        appended = np.concatenate(parts, axis=-1)
        appended[..., self._places] = calibrate(appended[..., self._places], calibration)
        return appended


def choose_vehicle(estimator: AnyEstimator, built: Vehicle, vehicle: Vehicle) -> Vehicle:
    """Choose a filter's car: `vehicle` with stiffness and friction of `built` where these may stay.

    Where gains follow P no gain is designed from the stiffnesses, and `set_stiffness` suffices.

    Args:
        estimator: The estimator at hand.
        built: Vehicle for which it was built.
        vehicle: True vehicle.
    """
    if isinstance(estimator, ForeignEstimator) or estimator.filters[0].gain_rule > GAIN.split:
        return vehicle
    fixed = ("name", "friction", *STIFFNESSES)
    return vehicle.replace(**{name: getattr(built, name) for name in fixed})


def set_stiffness(estimator: AnyEstimator, vehicle: Vehicle) -> None:
    """Set a filter's cornering stiffnesses from its next reset on; a user's own estimator stays.

    Args:
        estimator: The estimator.
        vehicle: Vehicle with the stiffnesses (N/rad).
    """
    if isinstance(estimator, Estimator):
        for f in estimator.filters:
            f.car[CAR.C_f], f.car[CAR.C_r] = vehicle.front_stiffness, vehicle.rear_stiffness


def refuse_stacked(env: Any, kind: type) -> None:
    """Raise ValueError where a wrapper of a kind is inside: readings would be calibrated twice.

    Args:
        env: Env or vector env, with its wrappers.
        kind: Class of the wrapper.
    """
    while env is not env.unwrapped:
        if isinstance(env, kind):
            raise ValueError(
                f"one {kind.__name__} takes all parameters and states; two are stacked"
            )
        env = env.env


class TruthObservation(gym.ObservationWrapper[_Floats, Any, _Floats], RecordConstructorArgs):
    """Appends parameters of the true car, as they are at the reset, and true states.

    Beside states `true_friction` is the present one. Readings of steering, wheels and motors lose
    the constant errors that a `World` draws; the references, by which all are judged, are made from
    what the env's own sensors read. It makes the oracles with which others are compared
    (`agents.baselines`), and stands outside of any `EstimateObservation`. `layout` describes the
    whole observation.

    Args:
        env: Environment with a `layout`.
        parameters: Names of `Vehicle`, appended as `true_<name>` in their units.
        states: Names of `TrueState`, appended as `<name>_hat` as if by an estimator without error.

    Raises:
        ValueError: A name is unknown or stands twice, or another one is inside.
    """

    def __init__(
        self, env: gym.Env[_Floats, Any], parameters: Sequence[str] = STIFFNESSES,
        states: Sequence[str] = (),
    ) -> None:  # fmt: skip
        RecordConstructorArgs.__init__(self, parameters=list(parameters), states=list(states))
        gym.Wrapper.__init__(self, env)
        refuse_stacked(env, type(self))
        self._entries = TruthEntries(parameters, states, env.get_wrapper_attr("layout"))
        self.layout = self._entries.layout
        self.observation_space = make_space(self.layout)
        self._values = np.zeros(len(parameters), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[_Floats, dict[str, Any]]:
        """Reset the env and read its car.

        Args:
            seed: Seed of the env, or None.
            options: Options of the env's reset, or None.
        """
        obs, info = self.env.reset(seed=seed, options=options)
        base: Any = self.unwrapped
        self._values, self._calibration = self._entries.read(base.car_truth)
        return self.observation(obs), info

    def observation(self, observation: _Floats) -> _Floats:
        """Append parameters and states, float32, shape (len(layout),).

        Args:
            observation: Observation of the env, float32, shape (inner,).
        """
        base: Any = self.unwrapped
        true_state = base.true_state if self._entries.states else None
        return self._entries.append(observation, self._values, self._calibration, true_state)

    def get_state(self) -> dict[str, object]:
        """Return a snapshot of the env and the parameters for `set_state`."""
        truth = {"values": self._values.copy(), "calibration": self._calibration.copy()}
        return {"env": self.env.get_wrapper_attr("get_state")()} | truth

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of this env or of one built with the same arguments.

        Args:
            snapshot: Result of `get_state`.
        """
        self.env.get_wrapper_attr("set_state")(snapshot["env"])
        self._values = snapshot["values"].copy()
        self._calibration = snapshot["calibration"].copy()
