"""The base of all classical controllers: named inputs, batches, memory outside the object."""

import math
from collections.abc import Callable
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.engine.config import make_car
from ...envs.numerics.jit import as_python, jit
from ...envs.numerics.primitives import ARRAYS, Scalar
from ...envs.record import Array
from ...envs.task import REFERENCES, make_reference_params
from ...envs.vehicle.actuators import compute_torque_limit
from ...envs.vehicle.linear import Bicycle
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from ..env_info import AnyEnv, get_env_facts

_torque_limit = as_python(compute_torque_limit, ARRAYS)
FRICTION = "true_friction"  # the entry whose friction a grip limit goes by, where it is there


class Controller:
    """The base of controllers: stable-baselines3's `predict` around a compiled law.

    A subclass names its inputs (`needs`, entries of the env's layout) and how many numbers it
    remembers (`memory`), and has a compiled `law`, or fills `_law`. `predict` is pure: all memory
    is in `state`, an array (N, memory). A controller serves a single env or all rows of a vector
    env, with one design.

    Where an entry is not finite the action is NaN and the memory stays as it was, which makes a
    failed estimator visible: an env with `on_bad_action="fail"` ends the episode, others raise.
    Raises ValueError for a missing entry.

    Args:
        env: Env whose nominal car and layout the controller is designed for.
        grip: Fraction of the rear tyres' friction force for the yaw moment; the rest is for lateral
            force. None: no limit. Friction: `true_friction`, else the nominal car's. TypeError for
            no number, ValueError unless positive.
    """

    needs: tuple[str, ...] = ()  # entries of the observation that the controller reads
    memory = 0  # numbers of memory for each row
    knows_friction = False  # whether it reads the true friction, if that is there, without a grip
    vehicle: Vehicle  # the car that the controller is designed for
    law: Callable[..., None]  # compiled: inputs, state, action, largest moments, `_design`
    _design: tuple[Any, ...]  # numbers of the law

    def __init__(self, env: AnyEnv, grip: float | None = None) -> None:
        if not hasattr(self, "law") and type(self)._law is Controller._law:
            raise TypeError(f"{type(self).__name__} has no law: give it `law` or `_law`")
        facts = get_env_facts(env)
        names = facts.names
        self.grip = None if grip is None else check_positive("grip", grip)
        self._true_friction = (grip is not None or self.knows_friction) and FRICTION in names
        if self._true_friction:
            self.needs = (*self.needs, FRICTION)
        missing = [name for name in self.needs if name not in names]
        if missing:
            text = f"{type(self).__name__} needs {', '.join(missing)} in the observation"
            raise ValueError(text + _describe_wrapper(missing))
        self._columns = np.array([names.index(name) for name in self.needs], dtype=np.int64)
        self._n_entries, self.width = len(names), facts.width  # of an observation, of an action
        self.nominal = self.vehicle = facts.nominal
        self.full_scale, self.authority = facts.full_scale, facts.authority
        self.control_period, self.reference = facts.control_period, facts.reference
        self._reference_kind = REFERENCES.index(facts.reference)
        self._target = make_reference_params(facts.nominal)

    def __repr__(self) -> str:
        grip = "" if self.grip is None else f", grip {self.grip:g}"
        reads = ", ".join(dict.fromkeys(self.needs)) or "nothing"
        return f"<{type(self).__name__} for {self.vehicle.name}{grip}; reads {reads}>"

    @property
    def _bicycle(self) -> Bicycle:
        """Numbers by which laws know the nominal car."""
        return Bicycle(*map(float, self.nominal.lateral))

    def _get_friction(self, inputs: Array) -> Array:
        """Friction that a grip limit uses, shape (N,)."""
        return inputs[:, -1] if self._true_friction else np.full(len(inputs), self.nominal.friction)

    def _compute_max_moment(self, inputs: Array) -> Array:
        """Compute the largest yaw moment as a fraction of full scale, shape (N,)."""
        car, max_share = self.vehicle, np.ones(len(inputs))
        # the motors' power is a limit at the measured speed (columns 0 and 1, the front wheels)
        if car.motor_power > 0.0:
            max_share = _torque_limit(inputs[:, :2].mean(axis=1), make_car(car)) / car.motor_torque
        if self.grip is None:
            return max_share
        load = car.mass * GRAVITY * car.front_arm / (2.0 * car.wheelbase)  # N, of a rear tyre
        # both rear tyres at mu F_z, one pulling and one braking: N_z = 2 (mu F_z) (d_r / 2), as a
        # fraction of full scale
        per_friction = self.grip * load * car.rear_track / self.full_scale
        return np.minimum(per_friction * self._get_friction(inputs), max_share)

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        """Compute the action and the next memory, in place; NaN in an action: the law failed.

        Args:
            inputs: Entries of `needs`, finite, shape (N, len(needs)).
            state: Memory, shape (N, memory), updated.
            action: Zeros of shape (N, width), to be filled: yaw moment as a fraction of full scale
                and, where the env steers, added steering as a fraction of the vehicle's authority.
        """
        self.law(inputs, state, action, self._compute_max_moment(inputs), self._design)

    def _mark_not_finite(self, rows: npt.NDArray[np.bool_], state: Array) -> None:
        """Note the rows (N,) whose inputs are not finite, in the state (N, memory) or elsewhere."""

    def record_action(self, state: Array, action: npt.NDArray[np.float32]) -> None:
        """Update the state where the env gets an action other than the controller's own."""

    def predict(
        self, observation: npt.NDArray[np.float32], state: Array | None = None,
        episode_start: npt.NDArray[np.bool_] | None = None, deterministic: bool = True,
    ) -> tuple[npt.NDArray[np.float32], Array]:  # fmt: skip
        """Compute the action in [-1, 1], shape (width,) or (N, width), and the next state.

        Args:
            observation: Observation, shape (k,) or (N, k); ValueError for another width.
            state: Memory, shape (N, memory); None at the start.
            episode_start: Rows whose memory is cleared, shape (N,).
            deterministic: Without effect.
        """
        obs = np.asarray(observation)
        if obs.shape[-1] != self._n_entries or obs.ndim > 2:
            raise ValueError(f"expected observations of width {self._n_entries}, got {obs.shape}")
        batch = obs.reshape(-1, self._n_entries)
        memory = np.zeros((len(batch), self.memory)) if state is None else np.array(state)
        if episode_start is not None:
            memory[np.asarray(episode_start, bool)] = 0.0
        action = np.zeros((len(batch), self.width))
        inputs = batch[:, self._columns].astype(np.float64)
        bad = np.asarray(~np.isfinite(inputs).all(axis=1))
        before, inputs[bad] = memory[bad], 0.0
        self._law(inputs, memory, action)
        if bad.any():
            memory[bad], action[bad] = before, np.nan
            self._mark_not_finite(bad, memory)
        shares = np.clip(action, -1.0, 1.0).astype(np.float32)
        return (shares[0] if obs.ndim == 1 else shares), memory


def _describe_wrapper(missing: list[str]) -> str:
    """Describe the wrapper whose observation has these entries."""
    if any(name.startswith("true_") for name in missing):
        return "; wrap the env in sideslip.estimators.wrappers.truth.TruthObservation"
    if any(name.endswith("_hat") for name in missing):
        return "; wrap the env in sideslip.estimators.EstimateObservation"
    return ""


def check_positive(name: str, value: float, allow_zero: bool = False) -> float:
    """Return a number that must be positive and finite; TypeError or ValueError for another.

    Args:
        name: Name of the option, for the message.
        value: Number to check.
        allow_zero: Whether it may be zero too.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name} is a number, got {value!r}")
    if not 0.0 <= value < math.inf or (value == 0.0 and not allow_zero):
        rule = "number of zero or more" if allow_zero else "positive number"
        raise ValueError(f"{name} is a {rule}, got {value!r}")
    return float(value)


@jit
def integrate_antiwindup(integral: Scalar, step: Scalar, raw: Scalar, limited: Scalar) -> Scalar:
    """Integrate a step, unless it would push the output further past its limit.

    Args:
        integral: Integral before the step.
        step: Increment of the integral.
        raw: Output before its limits.
        limited: Output within its limits.
    """
    if raw == limited or (raw > limited) != (step > 0.0):
        return integral + step
    return integral


class NoControl(Controller):
    """The uncontrolled car."""

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        pass
