"""A drive: from a scenario's fields to the time series of what the car did.

Cars and controllers under test are drives too: of an environment of ours or of an outside plant.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...agents import make_agent
from ...agents.learned.policy import load_policy
from ...agents.rollout import iterate_steps
from ...envs.outside.plants import OUTSIDE_PLANTS, OutsideInputs, OutsidePlant, make_outside_vehicle
from ...envs.record import Array
from ...envs.scenarios.draws import Draws
from ...envs.scenarios.scenario import Scenario
from ...envs.scenarios.steering import (
    STEERING_KINDS,
    STEERING_WIDTH,
    compute_steering,
    write_steering,
)
from ...envs.ticks import TICK
from ...envs.vehicle.dynamics import Motion
from ...envs.vehicle.parameters import COMS, PASSENGER_CAR, Vehicle
from ..harness.drives import make_env

Fields = Mapping[str, Any]

CALM: dict[str, Any] = {
    "name": "procedure",
    "disturbance_force": 0.0,
    "disturbance_moment": 0.0,
    "half_width": 1e6,  # m
}
"""A proving ground without wind: what every procedure's scenario starts from."""


@dataclass(frozen=True)
class Series:
    """The motion of a car at even times, shape (n,) each, SI units."""

    t: Array
    steer: Array  # of the front wheels
    v_x: Array  # of the centre of gravity, as all that follow
    v_y: Array
    gamma: Array
    psi: Array
    X: Array
    Y: Array
    moment: Array  # N m, the yaw moment delivered
    failed: bool = False  # the episode ended by a failure

    def __post_init__(self) -> None:
        for name, values in vars(self).items():
            if name != "failed" and values.shape != self.t.shape:
                raise ValueError(f"{name} has shape {values.shape}, the times {self.t.shape}")

    @property
    def beta(self) -> Array:
        """The sideslip angle (rad)."""
        return np.arctan2(self.v_y, self.v_x)

    @property
    def a_y(self) -> Array:
        """The lateral acceleration (m/s2), v_y' + v_x gamma."""
        return np.gradient(self.v_y, self.t) + self.v_x * self.gamma

    def interpolate(self, name: str, time: float) -> float:
        """Interpolate a signal between two samples.

        Args:
            name: Name of the signal.
            time: Time (s).

        Returns:
            Value; NaN after the end.
        """
        values = np.asarray(getattr(self, name))
        return float(np.interp(time, self.t, values, right=np.nan))


DriveFunction = Callable[[Fields], Series]
"""From fields of a `Scenario` to what the car did."""

Law = Callable[[Motion, float], float]
"""A yaw moment in N m from the true motion and the steering angle."""

_SPEED_GAIN = 10.0  # 1/s, of the speed that an outside plant's driver holds


def make_env_drive(
    env_id: str,
    agent: str = "none",
    estimator: str = "",
    seed: int = 0,
    estimate: Fields | None = None,
    agent_options: Fields | None = None,
    **options: Any,
) -> DriveFunction:
    """Make drives of an environment of ours with a controller and, if named, its estimator.

    Args:
        env_id: Id of the environment.
        agent: Name of the controller.
        estimator: Name of the estimator that it reads, "" for none.
        seed: Seed of every drive.
        estimate: Options of the estimator's wrapper.
        agent_options: Options of the controller.
        **options: Options of the environment (vehicle, nominal, control_period, model).

    Returns:
        The function that drives.
    """

    def run_drive(fields: Fields) -> Series:
        env = make_env(env_id, estimator, estimate, scenario=CALM | dict(fields), **options)
        base: Any = env.unwrapped
        rows = []
        for step in iterate_steps(env, make_agent(agent, env, **(agent_options or {})), seed):
            info = step.info
            rows.append([info["t"], info["steer"], *_get_motion(base.motion), info["yaw_moment"]])
        env.close()
        return _make_series(rows, bool(info["failure"]))

    return run_drive


def _make_series(rows: list[list[float]], failed: bool) -> Series:
    t, steer, v_x, v_y, gamma, psi, X, Y, moment = np.array(rows).T
    return Series(t, steer, v_x, v_y, gamma, psi, X, Y, moment, failed)


def _get_motion(m: Motion) -> tuple[float, ...]:
    return m.v_x, m.v_y, m.gamma, m.psi, m.X, m.Y


def make_plant_drive(model: str, law: Law | None = None) -> DriveFunction:
    """Make drives of an outside plant alone, its steering angle prescribed and no actuator's lag.

    The scenario's field `acceleration` None holds the speed, 0 lets the car coast.

    Args:
        model: Name of the plant, of `OUTSIDE_PLANTS`.
        law: Law of the yaw moment, evaluated every millisecond; None: no moment.

    Returns:
        The function that drives.
    """

    def run_drive(fields: Fields) -> Series:
        scenario = Scenario(**(CALM | dict(fields)))
        profile, hold = _make_steering_profile(scenario), scenario.acceleration is None
        return _simulate_plant(
            OUTSIDE_PLANTS[model](None),
            lambda t: float(compute_steering(t / TICK, profile)),
            scenario.range("speed")[0],
            scenario.duration,
            hold,
            law,
        )

    return run_drive


def _simulate_plant(
    plant: OutsidePlant,
    steering: Callable[[float], float],
    speed: float,
    duration: float,
    hold: bool = False,
    law: Law | None = None,
) -> Series:
    """Simulate an outside plant from straight ahead under a steering angle (rad) over time (s).

    hold: a force keeps the speed (m/s); otherwise the car coasts.
    """
    plant.start(Motion(speed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    rows = [[0.0, steering(0.0), *_get_motion(plant.motion), 0.0]]
    for k in range(round(duration / TICK)):
        steer, motion = steering(k * TICK), plant.motion
        moment = 0.0 if law is None else law(motion, steer)
        push = plant.p.m * plant.p.R_w * _SPEED_GAIN * (speed - motion.v_x) if hold else 0.0
        turn = plant.p.R_w / plant.p.T_r * moment
        plant.step(OutsideInputs(steer, 0.5 * push - turn, 0.5 * push + turn), TICK)
        if not plant.is_finite:
            break
        rows.append([(k + 1) * TICK, steer, *_get_motion(plant.motion), moment])
    return _make_series(rows, not plant.is_finite)


def _make_steering_profile(scenario: Scenario) -> Array:
    """Make the numbers that `compute_steering` reads, of a scenario that draws nothing.

    Raises ValueError for a range: a procedure leaves nothing to the seed.
    """
    low, high = scenario.get_draw_ranges()
    if (low != high).any():
        raise ValueError(f"scenario {scenario.name!r} draws; a procedure gives numbers")
    profile = np.zeros(STEERING_WIDTH)
    write_steering(STEERING_KINDS.index(scenario.steering), Draws(*low.tolist()), profile)
    return profile


@dataclass(frozen=True)
class TestCar:
    """A car on the proving ground."""

    vehicle: Vehicle
    speed: float  # m/s, of the procedures that prescribe one
    ratio: float  # of the steering wheel's angle to the front wheels'
    length: float  # m, of its body
    front_overhang: float  # m, of its body, from the front axle forward

    __test__ = False  # pytest would take it for tests


ENV_ID, OUTSIDE_ID = "sideslip/YawFusion-v0", "sideslip/Outside-v0"
_RATIO = 16.0  # steering wheel to front wheels, a usual rack's

# The standards' 80 km/h is the passenger car's. The COMS oversteers and is unstable above 63 km/h;
# half of 80 km/h is to it what 80 km/h is to a car.
CARS: dict[str, TestCar] = {
    "coms": TestCar(COMS, 40.0 / 3.6, _RATIO, 2.395, 0.5),
    "passenger-car": TestCar(PASSENGER_CAR, 80.0 / 3.6, _RATIO, 4.2, 0.8),
}


def make_outside_car() -> TestCar:
    """Make CommonRoad's BMW 320i at 80 km/h (needs the extra `outside`)."""
    return TestCar(make_outside_vehicle(), 80.0 / 3.6, _RATIO, 4.508, 0.8)


@dataclass(frozen=True)
class ProcedureEntry:
    """A controller with the estimator that it reads ("" for none)."""

    agent: str
    estimator: str = ""
    estimate: Mapping[str, Any] = field(default_factory=dict)  # options of the estimator's wrapper
    slow: bool = False  # it plans, and is left out of a quick run
    policies: Mapping[str, str] = field(default_factory=dict)  # learned, with its estimator, by car

    def get_configuration(self, car: str) -> tuple[str, str, Mapping[str, Any]]:
        """Get what drives a car.

        Args:
            car: One of `CARS`, or an outside model, which is taken for the passenger car.

        Returns:
            Agent, estimator and the options of its wrapper.
        """
        if not self.policies:
            return self.agent, self.estimator, self.estimate
        name = self.policies.get(car, self.policies["passenger-car"])
        card = load_policy(name).card
        return name, card.estimator, card.estimator_options

    def drive(self, car: str, seed: int = 0) -> DriveFunction:
        """Make the drives of a car; references stay within what friction can hold.

        Args:
            car: One of `CARS`.
            seed: Seed of every drive.

        Returns:
            The function that drives.
        """
        options: dict[str, Any] = {"vehicle": CARS[car].vehicle.to_dict(), "reference": "limited"}
        agent, estimator, estimate = self.get_configuration(car)
        return make_env_drive(ENV_ID, agent, estimator, seed, estimate, **options)


_TYRES = {"outputs": ["beta", "gamma", "F_d", "N_d", "front_tyres", "rear_tyres"]}
_FRICTION = {
    "outputs": [*_TYRES["outputs"], "inverse_friction"],
    "options": {"inverse_friction_sd": 0.3},
}
_DISTILLED = {"coms": "distill-coms-yaw", "passenger-car": "distill-car-yaw"}
ENTRIES = (
    ProcedureEntry("none"),
    ProcedureEntry("feedforward"),
    ProcedureEntry("two-dof", "exact-kf"),
    ProcedureEntry("lqr", "exact-kf"),
    ProcedureEntry("esc"),
    ProcedureEntry("adaptive-lqr", "joint", _TYRES),
    ProcedureEntry("adaptive-nmpc", "joint", _FRICTION, slow=True),
    ProcedureEntry("distilled", policies=_DISTILLED),
)
