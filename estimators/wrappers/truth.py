"""TruthObservation: parameters and states of the true car beside the observation."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.utils import RecordConstructorArgs

from ...envs.engine.views import TRUE_STATE
from ...envs.record import Array
from ...envs.task import ObservationEntry, make_space
from ...envs.vehicle.parameters import Vehicle
from ..estimator import Estimator
from ..protocol import ForeignEstimator

_Floats = npt.NDArray[np.float32]
TRUTH = "truth"  # in place of a vehicle: the one that is driven
STIFFNESSES = ("front_stiffness", "rear_stiffness")
_MAX_PARAMETER = 1e7  # bound of any parameter of a vehicle, SI
_STATES = {
    "beta": ("rad", math.pi),
    "gamma": ("rad/s", 20.0),
    "F_d": ("N", _MAX_PARAMETER),
    "N_d": ("N m", _MAX_PARAMETER),
    "phi": ("rad", math.pi),
    "phi_rate": ("rad/s", 100.0),
}


def make_truth_entries(
    parameters: Sequence[str], states: Sequence[str], inner: Sequence[ObservationEntry]
) -> tuple[ObservationEntry, ...]:
    """Make the entries of true parameters and states behind those of an observation.

    Args:
        parameters: Parameters of a `Vehicle`, each as `true_<parameter>`.
        states: States of a `TrueState`, each as `<state>_hat`.
        inner: Entries of the observation.

    Returns:
        All entries.

    Raises:
        ValueError: A parameter or state is unknown, or a name would stand twice.
    """
    fields = {field.name: field.metadata.get("unit") for field in dataclasses.fields(Vehicle)}
    entries = []
    for name in parameters:
        unit = fields.get(name)
        if unit is None:
            known = ", ".join(key for key, value in fields.items() if value is not None)
            raise ValueError(f"a vehicle has no parameter {name!r}; it has: {known}")
        entries.append(ObservationEntry(f"true_{name}", unit, -_MAX_PARAMETER, _MAX_PARAMETER))
    for name in states:
        if name not in _STATES:
            raise ValueError(f"there is no true state {name!r}; there is: {', '.join(_STATES)}")
        unit, limit = _STATES[name]
        entries.append(ObservationEntry(f"{name}_hat", unit, -limit, limit))
    names = [entry.name for entry in (*inner, *entries)]
    duplicates = sorted({name for name in names if names.count(name) > 1})
    if duplicates:
        raise ValueError(f"{', '.join(duplicates)} would stand twice in the observation")
    return (*inner, *entries)


def read_states(true_state: Array, states: Sequence[str]) -> _Floats:
    """Read true states, clipped to their bounds.

    Args:
        true_state: States, shape (..., len(TrueState)).
        states: Names of states.

    Returns:
        Values in SI units, shape (..., len(states)).
    """
    limits = np.array([_STATES[name][1] for name in states])
    columns = [getattr(TRUE_STATE, name) for name in states]
    values: Array = true_state[..., columns].clip(-limits, limits)
    return values.astype(np.float32)


def choose_vehicle(
    estimator: Estimator | ForeignEstimator, built: Vehicle, vehicle: Vehicle
) -> Vehicle:
    """Choose the car to build an estimator for, so that the one at hand serves wherever it can.

    Where gains follow P no gain is designed from the stiffnesses, and `set_stiffness` suffices.

    Args:
        estimator: The estimator at hand.
        built: Vehicle for which it was built.
        vehicle: True vehicle.

    Returns:
        `vehicle`, with the stiffnesses and the friction of `built` where these may stay.
    """
    if isinstance(estimator, ForeignEstimator) or estimator.filters[0].periodic:
        return vehicle
    fixed = ("name", "friction", *STIFFNESSES)
    return vehicle.replace(**{name: getattr(built, name) for name in fixed})


def set_stiffness(estimator: Estimator | ForeignEstimator, vehicle: Vehicle) -> None:
    """Set a filter's cornering stiffnesses from its next reset on; a user's own estimator stays.

    Args:
        estimator: The estimator.
        vehicle: Vehicle with the stiffnesses (N/rad).
    """
    if isinstance(estimator, Estimator):
        for f in estimator.filters:
            f.car[4], f.car[5] = vehicle.front_stiffness, vehicle.rear_stiffness


class TruthObservation(gym.ObservationWrapper[_Floats, Any, _Floats], RecordConstructorArgs):
    """Appends parameters of the true car, as they are at the reset, and true states.

    No sensor measures these: it makes the oracles with which others are compared
    (`agents.baselines`), and stands outside of any `EstimateObservation`. `layout` describes the
    whole observation.

    Args:
        env: Environment with a `layout`.
        parameters: Names of `Vehicle`, appended as `true_<name>` in their units.
        states: Names of `TrueState`, appended as `<name>_hat` as if by an estimator without error.
    """

    def __init__(
        self,
        env: gym.Env[_Floats, Any],
        parameters: Sequence[str] = STIFFNESSES,
        states: Sequence[str] = (),
    ) -> None:
        RecordConstructorArgs.__init__(self, parameters=list(parameters), states=list(states))
        gym.Wrapper.__init__(self, env)
        self._parameters, self._states = tuple(parameters), tuple(states)
        inner = env.get_wrapper_attr("layout")
        self.layout = make_truth_entries(self._parameters, self._states, inner)
        self.observation_space = make_space(self.layout)
        self._values = np.zeros(len(self._parameters), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[_Floats, dict[str, Any]]:
        """Reset the env and read its car.

        Args:
            seed: Seed of the env, or None.
            options: Options of the env's reset, or None.

        Returns:
            Observation and info.
        """
        obs, info = self.env.reset(seed=seed, options=options)
        base: Any = self.unwrapped
        self._values[:] = [getattr(base.vehicle, name) for name in self._parameters]
        return self.observation(obs), info

    def observation(self, observation: _Floats) -> _Floats:
        """Append parameters and states.

        Args:
            observation: Observation of the env, float32, shape (inner,).

        Returns:
            Observation of the wrapper, float32, shape (len(layout),).
        """
        base: Any = self.unwrapped
        states = [read_states(base.true_state, self._states)] if self._states else []
        return np.concatenate([observation, self._values, *states])

    def get_state(self) -> dict[str, object]:
        """Return a snapshot of the env and the parameters for `set_state`."""
        return {"env": self.env.get_wrapper_attr("get_state")(), "values": self._values.copy()}

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of this env or of one built with the same arguments.

        Args:
            snapshot: Result of `get_state`.
        """
        self.env.get_wrapper_attr("set_state")(snapshot["env"])
        self._values = snapshot["values"].copy()
