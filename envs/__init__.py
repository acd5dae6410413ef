"""The car, its sensors and the Gymnasium environment around them."""

# A second copy under another name breaks pickles and poisons numba's cache.
if __name__ != "sideslip.envs":
    raise ImportError(f"this folder is the package sideslip.envs; it was imported as {__name__}")

from .record import Log, Record
from .scenarios.manoeuvres import SCENARIOS, make_scenario
from .scenarios.scenario import Scenario
from .scenarios.world import World, make_world
from .sensors.link import SlowSensor
from .stability import StabilityEnv
from .task import FAILURES, ObservationEntry
from .vector import StabilityVectorEnv
from .vehicle.parameters import COMS, PASSENGER_CAR, VEHICLES, Vehicle, critical_speed, make_vehicle

__all__ = [
    "COMS", "FAILURES", "PASSENGER_CAR", "SCENARIOS", "VEHICLES", "Log", "ObservationEntry",
    "Record", "Scenario", "SlowSensor", "StabilityEnv", "StabilityVectorEnv", "Vehicle", "World",
    "critical_speed", "make_scenario", "make_vehicle", "make_world",
]  # fmt: skip
