"""Cars and controllers under test, as drives."""

from dataclasses import dataclass
from typing import Any

from ...envs.outside.plants import outside_vehicle
from ...envs.vehicle.vehicle import COMS, PASSENGER_CAR
from .drive import Drive, TestCar, of_env

ENV_ID, OUTSIDE_ID = "sideslip/YawFusion-v0", "sideslip/Outside-v0"
RATIO = 16.0  # steering wheel to front wheels, a usual rack's

# The standards' 80 km/h is the passenger car's. The COMS oversteers and is unstable above 63 km/h;
# half of 80 km/h is to it what 80 km/h is to a car.
CARS: dict[str, TestCar] = {
    "coms": TestCar(COMS, 40.0 / 3.6, RATIO, 2.395, 0.5),
    "passenger-car": TestCar(PASSENGER_CAR, 80.0 / 3.6, RATIO, 4.2, 0.8),
}


def outside_car() -> TestCar:
    """CommonRoad's BMW 320i at 80 km/h (needs the extra `outside`)."""
    return TestCar(outside_vehicle(), 80.0 / 3.6, RATIO, 4.508, 0.8)


@dataclass(frozen=True)
class Contestant:
    """A controller with the estimator it reads ("" where it reads none)."""

    agent: str
    estimator: str = ""

    def drive(self, car: str, seed: int = 0) -> Drive:
        """Drives of one of `CARS`; references stay within what friction can hold."""
        options: dict[str, Any] = {"vehicle": CARS[car].vehicle.to_dict(), "reference": "limited"}
        return of_env(ENV_ID, self.agent, self.estimator, seed, **options)


CONTESTANTS = (
    Contestant("none"),
    Contestant("feedforward"),
    Contestant("two-dof", "exact-kf"),
    Contestant("lqr", "exact-kf"),
    Contestant("esc"),
)
