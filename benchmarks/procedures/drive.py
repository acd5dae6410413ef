"""A drive: from a scenario's fields to what the car did over time; the cars and the controllers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...agents import Agent, make_agent
from ...agents.learned.policy import load_policy
from ...agents.rollout import iterate_steps
from ...envs.record import Array
from ...envs.task import make_reference_params
from ...envs.vehicle.parameters import COMS, PASSENGER_CAR, Vehicle
from ..control.entries import ControlCase, Entry
from ..control.tasks import STEERING, ControlTask
from ..harness.drives import make_env

Fields = Mapping[str, Any]

# a proving ground without wind: what every procedure's scenario starts from
CALM: dict[str, Any] = {"name": "procedure", "half_width": 1e6}  # m
CALM |= {"disturbance_force": 0.0, "disturbance_moment": 0.0}


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
    failed: bool = False  # the episode ended by a failure

    @property
    def beta(self) -> Array:
        """The sideslip angle (rad)."""
        return np.arctan2(self.v_y, self.v_x)

    @property
    def a_y(self) -> Array:
        """The lateral acceleration (m/s2), v_y' + v_x gamma."""
        return np.gradient(self.v_y, self.t) + self.v_x * self.gamma


POSE = 6  # numbers of a `Motion` in a series, from v_x to Y
DriveFunction = Callable[[Fields], Series]  # from fields of a `Scenario` to what the car did


@dataclass(frozen=True)
class TestCar:
    """A car on the proving ground."""

    vehicle: Vehicle
    speed: float  # m/s, of the procedures that prescribe one
    ratio: float  # of the steering wheel's angle to the front wheels'
    length: float  # m, of its body
    front_overhang: float  # m, of its body, from the front axle forward

    __test__ = False  # pytest would take it for tests

    @property
    def understeer_gradient(self) -> float:
        """The understeer gradient K of the linear model (rad s2/m)."""
        return float(make_reference_params(self.vehicle).G) * self.vehicle.wheelbase


ENV_ID = STEERING.replace("-v0", "-v1")  # of every drive
_RATIO = 16.0  # steering wheel to front wheels, a usual rack's

# The standards' 80 km/h is the passenger car's. The COMS oversteers and is unstable above 63 km/h;
# half of 80 km/h is to it what 80 km/h is to a car.
CARS: dict[str, TestCar] = {
    "coms": TestCar(COMS, 40.0 / 3.6, _RATIO, 2.395, 0.5),
    "passenger-car": TestCar(PASSENGER_CAR, 80.0 / 3.6, _RATIO, 4.2, 0.8),
}


@dataclass(frozen=True)
class ProcedureEntry:
    """A controller with the estimator that it reads ("" for none)."""

    agent: str
    estimator: str = ""
    estimate: Mapping[str, Any] = field(default_factory=dict)  # options of the estimator's wrapper
    slow: bool = False  # it plans, and is left out of a quick run
    policies: Mapping[str, str] = field(default_factory=dict)  # learned, with its estimator, by car

    def get_configuration(self, car: str) -> tuple[str, str, Mapping[str, Any]]:
        """Get agent, estimator and its options for a car; outside models are passenger cars."""
        if not self.policies:
            return self.agent, self.estimator, self.estimate
        name = self.policies.get(car, self.policies["passenger-car"])
        card = load_policy(name).card
        return name, card.estimator, card.estimator_options

    def make(self, car: str, env_id: str, **options: Any) -> tuple[Any, Agent]:
        """Make an env with the estimator, and the agent as it was tuned for the benchmark.

        Args:
            car: One of `CARS`, or an outside model, which is taken for the passenger car.
            env_id: Id of the env.
            options: Options of the env.
        """
        agent, estimator, estimate = self.get_configuration(car)
        env = make_env(env_id, estimator, estimate, **options)
        task = ControlTask(env_id=STEERING, vehicle=car if car in CARS else "passenger-car")
        tuned = ControlCase(task, Entry(agent, estimator)).agent_options
        return env, make_agent(agent, env, **tuned)

    def drive(self, car: str, seed: int | None = None) -> DriveFunction:
        """Make the drives of a car; references stay within what friction can hold."""
        options: dict[str, Any] = {"vehicle": CARS[car].vehicle.to_dict(), "reference": "limited"}
        options |= {"world": "ideal"} if seed is None else {}

        def run_drive(fields: Fields) -> Series:
            env, agent = self.make(car, ENV_ID, scenario=CALM | dict(fields), **options)
            rows = []
            for step in iterate_steps(env, agent, seed or 0):
                pose = env.unwrapped.motion[:POSE]
                rows.append([step.info["t"], step.info["steer"], *pose])
            env.close()
            return replace(Series(*np.array(rows).T), failed=bool(step.info["failure"]))

        return run_drive


_POLICIES = {"coms": "distill-coms-steering", "passenger-car": "distill-car-steering"}
_STATES = ["beta", "gamma", "F_d", "N_d"]
_FORCES: dict[str, Any] = {"outputs": _STATES, "options": {"slow": ["camera", "gps"]}}
_TYRES = {"outputs": [*_STATES, "front_tyres", "rear_tyres", "inverse_friction"]}
_ENTRIES = (
    ProcedureEntry("none"),
    ProcedureEntry("two-dof", "exact-kf", _FORCES),
    ProcedureEntry("model-following", "exact-kf", _FORCES),
    ProcedureEntry("esc"),
    ProcedureEntry("lqr", "exact-kf", _FORCES),
    ProcedureEntry("adaptive-lqr", "joint", _TYRES),
    ProcedureEntry("adaptive-nmpc", "joint", _TYRES, slow=True),
    ProcedureEntry("policy on joint", policies=_POLICIES),
)
ENTRIES = {entry.agent: entry for entry in _ENTRIES}


@dataclass(frozen=True)
class ProcedureCase:
    """A case: a procedure, a car or outside model, a controller of `ENTRIES`, seeds."""

    procedure: str
    car: str
    agent: str = "none"
    seeds: tuple[int, ...] = ()
    quick: bool = False


CaseResults = dict[ProcedureCase, Any]  # a result of the procedure's module by case
