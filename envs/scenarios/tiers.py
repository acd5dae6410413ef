"""Scenarios of the two scored tiers: the seed draws cars, manoeuvres and sensor faults.

Tier 1 is the COMS at 18 to 28 km/h. Tier 2 is the passenger car at 60 to 80 km/h: on a dry road
(2a), on a road of any friction (2b), and at the limit of its tyres (2c). Sensors have biases, a
late GPS, and an uneven camera that may lose the lane. The env names the car, a task the reference.
"""

import math

from ..vehicle.parameters import COMS, PASSENGER_CAR
from .draws import KMH
from .scenario import Fields, Scenario

_DEGREE = math.radians(1.0)

_DRAWN: Fields = {
    "mirror": True, "front_stiffness": (0.6, 1.4), "rear_stiffness": (0.6, 1.4),
    "camera_delays": (0.030,), "camera_jitter": 0.010, "camera_loss": 0.05, "camera_heading": 0.35,
    "camera_offset": 4.0, "gps_latency": (0.1, 0.3), "gyro_bias": (-0.5 * _DEGREE, 0.5 * _DEGREE),
    "accel_y_bias": (-0.2, 0.2),
    "bank": (-0.02, 0.02),  # the crossfall of a road that sheds water
    "curve_start": -100.0,  # there from the beginning
}  # fmt: skip
# 2 kW a wheel is assumed: the papers give the COMS's torque alone. The passenger car's 700 N m take
# 50 kW a wheel at 80 km/h, which is assumed to be there.
_COMS_PLANT = {"motor_power": 2000.0, "transfer_height": COMS.gravity_height}
_CAR_PLANT = {"transfer_height": PASSENGER_CAR.gravity_height}
_COMS = _DRAWN | {
    "speed": (18.0 * KMH, 28.0 * KMH), "friction": (0.7, 1.0), "vehicle": _COMS_PLANT,
    "nominal": _COMS_PLANT,
}  # fmt: skip
_CAR = _DRAWN | {"speed": (60.0 * KMH, 80.0 * KMH), "vehicle": _CAR_PLANT, "nominal": _CAR_PLANT}

RANDOM: Fields = {
    "steering": "random", "onset": (0.0, 1.0), "frequency": (0.3, 0.4), "frequency_2": (0.4, 0.8),
    "frequency_3": (0.2, 0.3), "frequency_4": (0.4, 0.6),
}  # fmt: skip
SLALOM: Fields = {"steering": "slalom", "onset": (0.5, 1.5), "frequency": (0.2, 0.6)}
STEP: Fields = {
    "duration": 8.0, "steering": "step", "onset": (0.5, 1.5), "hold": (1.0, 2.0),
}  # fmt: skip
SINE_WITH_DWELL: Fields = {  # FMVSS 126: 0.7 Hz, and half a second at the second peak
    "duration": 6.0, "steering": "sine-with-dwell", "onset": (0.5, 1.0), "frequency": (0.6, 0.8),
    "hold": 0.5,
}  # fmt: skip
BRAKE_IN_TURN: Fields = {  # the motors brake; they share their torque with the yaw moment
    "duration": 6.0, "steering": "held-step", "onset": (0.5, 1.0), "speed_change": -12.0 * KMH,
    "change_start": 2.0, "change_length": 2.0,
}  # fmt: skip
DOUBLE_LANE_CHANGE: Fields = {  # a section takes the time it takes at 25 to 32 km/h
    "duration": 6.0, "steering": "driver", "path": "iso-3888-2", "path_speed": (7.0, 9.0),
    "onset": (0.5, 1.0), "half_width": 2.0,
}  # fmt: skip
_ISO_3888_1: Fields = {
    "duration": 9.0, "steering": "driver", "path": "iso-3888-1", "onset": (0.5, 1.0),
    "half_width": 5.0,
}  # fmt: skip


def make_random_steering(low: float, high: float) -> Fields:
    """Make the fields of a random steering whose pairs of sines have amplitudes in a range.

    Args:
        low: Smallest amplitude (rad).
        high: Largest amplitude (rad).

    Returns:
        Fields of a `Scenario`.
    """
    return RANDOM | {"amplitude": (low, high), "amplitude_2": (low, high)}


def _set_amplitude(shape: Fields, low: float, high: float) -> Fields:
    """Set the range of a manoeuvre's steering amplitude (rad)."""
    return shape | {"amplitude": (low, high)}


def _make_scenarios(tier: str, common: Fields, **shapes: Fields) -> list[Scenario]:
    """Make a tier's scenarios from their fields by name, written with underscores."""
    scenarios = []
    for name, shape in shapes.items():
        # without a driver on a track the road follows the nominal car: the camera sees a lane
        road = "straight" if shape["steering"] == "driver" else "nominal-path"
        fields: Fields = {"road": road} | common | shape
        scenarios.append(Scenario(name=name.replace("_", "-"), tier=tier, **fields))
    return scenarios


# "gentle" and the step: what one yaw moment can hold at zero slip
_ONE = _make_scenarios(
    "1",
    _COMS,
    coms_random=make_random_steering(0.005, 0.015),
    coms_double_lane_change=DOUBLE_LANE_CHANGE,
    coms_slalom=_set_amplitude(SLALOM, 0.04, 0.1),
    coms_sine_with_dwell=_set_amplitude(SINE_WITH_DWELL, 0.05, 0.12),
    coms_brake_in_turn=_set_amplitude(BRAKE_IN_TURN, 0.04, 0.1),
    coms_gentle_slalom=_set_amplitude(SLALOM, 0.02, 0.05),
    coms_step=_set_amplitude(STEP, 0.015, 0.05),
)
_TWO_A = _make_scenarios(
    "2a",
    _CAR | {"friction": (0.9, 1.0)},
    car_random=make_random_steering(0.002, 0.006),
    car_slalom=_set_amplitude(SLALOM, 0.01, 0.025),
    car_step=_set_amplitude(STEP, 0.008, 0.025),
    car_sine_with_dwell=_set_amplitude(SINE_WITH_DWELL, 0.01, 0.03),
    car_iso_3888_1=_ISO_3888_1 | {"path_speed": (60.0 * KMH, 80.0 * KMH)},
)
# the nominal friction is the middle of what may come, as a designer would take it
_TWO_B = _make_scenarios(
    "2b",
    _CAR | {"friction": (0.3, 1.0), "nominal": _CAR_PLANT | {"friction": 0.65}},
    any_friction_random=make_random_steering(0.002, 0.006),
    any_friction_slalom=_set_amplitude(SLALOM, 0.01, 0.025),
    any_friction_step=_set_amplitude(STEP, 0.008, 0.025),
    any_friction_sine_with_dwell=_set_amplitude(SINE_WITH_DWELL, 0.01, 0.03),
    # sections as long as they are for 35 to 50 km/h: at 80 friction 0.3 holds no car on the track
    any_friction_iso_3888_1=_ISO_3888_1 | {"path_speed": (35.0 * KMH, 50.0 * KMH)},
)
_TWO_C = _make_scenarios(
    "2c",
    _CAR | {"friction": (0.6, 1.0), "nominal": _CAR_PLANT | {"friction": 0.8}},
    limit_slalom=_set_amplitude(SLALOM, 0.02, 0.06) | {"speed": (75.0 * KMH, 85.0 * KMH)},
    limit_sine_with_dwell=_set_amplitude(SINE_WITH_DWELL, 0.03, 0.08)
    | {"speed": (75.0 * KMH, 85.0 * KMH)},
    limit_step=_set_amplitude(STEP, 0.02, 0.06),
    limit_random=make_random_steering(0.01, 0.03) | {"speed": (55.0 * KMH, 65.0 * KMH)},
)

# Not scored, but mapped over where it starts: the driver does not steer, the car is caught or lost.
_RECOVERY = Scenario(
    name="recovery", duration=5.0, initial_beta=(0.05, 0.25), initial_gamma=(-0.5, 0.5), **_COMS
)

# Not scored either: drawn where a driver swerves around others, on `sideslip/Highway-v0`.
_WET_ROAD = _CAR | {
    "speed": (75.0 * KMH, 100.0 * KMH), "friction": (0.4, 0.7), "camera_offset": 6.0,
    "nominal": _CAR_PLANT | {"friction": 0.55}, "driver_gain": 2.0,  # startled
}  # fmt: skip
WET_EVASION = Scenario(name="wet-evasion", duration=6.0, steering="driver", **_WET_ROAD)

TIERS: tuple[Scenario, ...] = (*_ONE, *_TWO_A, *_TWO_B, *_TWO_C, _RECOVERY)
