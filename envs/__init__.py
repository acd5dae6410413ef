"""The car, its sensors and the Gymnasium environment around them."""

# A second copy under another name breaks pickles and poisons numba's cache.
if __name__ != "sideslip.envs":
    raise ImportError(f"this folder is the package sideslip.envs; it was imported as {__name__}")

from .record import Log, Record
from .scenarios.manoeuvres import SCENARIOS, scenario_from
from .scenarios.scenario import Scenario
from .sensors.link import SlowSensor
from .stability import StabilityEnv
from .task.failures import FAILURES
from .task.observation import Entry
from .vector import StabilityVectorEnv
from .vehicle.vehicle import COMS, PASSENGER_CAR, Vehicle, critical_speed
from .vehicle.vehicles import VEHICLES, vehicle_from

__all__ = [
    "COMS",
    "FAILURES",
    "PASSENGER_CAR",
    "SCENARIOS",
    "VEHICLES",
    "Entry",
    "Log",
    "Record",
    "Scenario",
    "SlowSensor",
    "StabilityEnv",
    "StabilityVectorEnv",
    "Vehicle",
    "critical_speed",
    "scenario_from",
    "vehicle_from",
]
