"""Cars and controllers under test, as drives."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ...agents.learned.files import load_policy
from ...envs.outside.plants import make_outside_vehicle
from ...envs.vehicle.vehicle import COMS, PASSENGER_CAR
from .drive import DriveFunction, TestCar, make_env_drive

ENV_ID, OUTSIDE_ID = "sideslip/YawFusion-v0", "sideslip/Outside-v0"
RATIO = 16.0  # steering wheel to front wheels, a usual rack's

# The standards' 80 km/h is the passenger car's. The COMS oversteers and is unstable above 63 km/h;
# half of 80 km/h is to it what 80 km/h is to a car.
CARS: dict[str, TestCar] = {
    "coms": TestCar(COMS, 40.0 / 3.6, RATIO, 2.395, 0.5),
    "passenger-car": TestCar(PASSENGER_CAR, 80.0 / 3.6, RATIO, 4.2, 0.8),
}


def make_outside_car() -> TestCar:
    """CommonRoad's BMW 320i at 80 km/h (needs the extra `outside`)."""
    return TestCar(make_outside_vehicle(), 80.0 / 3.6, RATIO, 4.508, 0.8)


@dataclass(frozen=True)
class ProcedureEntry:
    """A controller with the estimator it reads ("" where it reads none).

    estimate: options of the estimator's wrapper. slow: whether it plans, and is left out of a quick
    run. policies: by car, where the controller is learned; each has
    the estimator of its training.
    """

    agent: str
    estimator: str = ""
    estimate: Mapping[str, Any] = field(default_factory=dict)
    slow: bool = False
    policies: Mapping[str, str] = field(default_factory=dict)

    def get_configuration(self, car: str) -> tuple[str, str, Mapping[str, Any]]:
        """(agent, estimator, its options) on one of `CARS`; another car has the passenger car's."""
        if not self.policies:
            return self.agent, self.estimator, self.estimate
        name = self.policies.get(car, self.policies["passenger-car"])
        card = load_policy(name).card
        return name, card.estimator, card.estimator_options

    def drive(self, car: str, seed: int = 0) -> DriveFunction:
        """Drives of one of `CARS`; references stay within what friction can hold."""
        options: dict[str, Any] = {"vehicle": CARS[car].vehicle.to_dict(), "reference": "limited"}
        agent, estimator, estimate = self.get_configuration(car)
        return make_env_drive(ENV_ID, agent, estimator, seed, estimate, **options)


_TYRES = {"outputs": ["beta", "gamma", "F_d", "N_d", "front_tyres", "rear_tyres"]}
_FRICTION = {
    "outputs": [*_TYRES["outputs"], "inverse_friction"],
    "options": {"inverse_friction_sd": 0.3},
}
ENTRIES = (
    ProcedureEntry("none"),
    ProcedureEntry("feedforward"),
    ProcedureEntry("two-dof", "exact-kf"),
    ProcedureEntry("lqr", "exact-kf"),
    ProcedureEntry("esc"),
    ProcedureEntry("adaptive-lqr", "joint", _TYRES),
    ProcedureEntry("adaptive-nmpc", "joint", _FRICTION, slow=True),
    ProcedureEntry(
        "distilled", policies={"coms": "distill-coms-yaw", "passenger-car": "distill-car-yaw"}
    ),
)
