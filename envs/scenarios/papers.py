"""Scenarios of the papers' simulations and of their road tests, which no score contains.

docs/PAPERS.md lists the papers; the comment above each scenario says what its paper gives. The rest
is chosen here: by default the vehicle of tie-vision's Table I at 25 km/h, with the default
Ornstein-Uhlenbeck disturbance and noise. GPS noise is that at HDOP 1 in the simulations; in the
road tests half of it follows a varying HDOP.
"""

from ..vehicle.parameters import COMS
from .draws import KMH
from .scenario import Fields, Scenario


def _make_stiffness(stiffness: float) -> dict[str, float]:
    """Make the same stiffness (N/rad) of all tyres."""
    return {"front_stiffness": stiffness, "rear_stiffness": stiffness}


_SIMULATED: Fields = {  # the plant of the papers' own equations
    "small_angle": True, "tyres": "linear", "lags": False, "roll": False,
    "hdop": 1.0, "hdop_spread": 0.0, "hdop_law": "constant",
}  # fmt: skip
_ON_THE_ROAD: Fields = {"half_width": 200.0}  # m, a wide road; all else is the full plant
_QUIET: Fields = {"disturbance_force": 0.0, "disturbance_moment": 0.0}
_WIND: Fields = {"wind_force": 200.0, "wind_start": 4.0, "wind_length": 4.0}

# given: sine steering, 25 km/h, tyres 1.2 times the filter's
_FIG7 = Scenario(
    name="tie-vision-fig7", steering="sine", amplitude=0.1, frequency=0.5,
    vehicle=_make_stiffness(7200.0), **_SIMULATED,
)  # fmt: skip
# given: a single lane change at 25 km/h
_FIG8 = Scenario(
    name="tie-vision-fig8", duration=5.0, steering="lane-change", onset=0.5, amplitude=0.13,
    frequency=0.5, noise={"camera_psi": 0.0005, "camera_y": 0.003}, **_QUIET, **_SIMULATED,
)  # fmt: skip
# given: sine steering, 25 km/h, tyres 1.2 times the filter's, the delays
_UNEVEN = _FIG7.replace(
    name="uneven-delay-fig5", camera_delays=(0.020, 0.015, 0.010, 0.025),
    noise={"camera_psi": 0.001, "camera_y": 0.01}, **_QUIET,
)  # fmt: skip
# given: lane change by a sine, 25 km/h, wind 4-8 s, outage 4-6 s, tyres 7000 against 10000
_DAKF = Scenario(
    name="dakf-fig6", steering="lane-change", onset=0.5, amplitude=0.2, frequency=0.2, wind_arm=0.2,
    gps_outage=(4.0, 6.0), vehicle=_make_stiffness(7000.0), nominal=_make_stiffness(10000.0),
    **_WIND, **_SIMULATED,
)  # fmt: skip
# given: a step command, the front wheels turned by the EPS motor, tyres and wind as in Fig. 6
_DAKF_STEP = _DAKF.replace(
    name="dakf-fig7", steering="step", onset=1.0, amplitude=0.06, hold=100.0,  # it stays
    half_width=1e3,  # the small-angle car leaves on a parabola
    gps_outage=None, lags=True,
    vehicle={**_make_stiffness(7000.0), "motor_lag": 0.0, "steering_lag": 0.03},
)  # fmt: skip
# given: slalom with wind; measured is the course, with or without the gyro
_DUAL = Scenario(
    name="dual-rate-fig4", duration=12.0, steering="slalom", onset=1.0, amplitude=0.1,
    frequency=0.25, gps_period=0.1, vehicle=_make_stiffness(7000.0),
    nominal=_make_stiffness(9100.0), **_WIND, **_SIMULATED,
)  # fmt: skip
_TOO_STIFF = {  # given: 30 % on inertia, damping and stiffness, double-layer-gps (43)
    "roll_inertia": 1.3 * COMS.roll_inertia,
    "roll_damping": 1.3 * COMS.roll_damping,
    "roll_stiffness": 1.3 * COMS.roll_stiffness,
}
# given: tyres 7000 against 10000, the roll model 30 % off, course and speed at 5 Hz
_DOUBLE = Scenario(
    name="double-layer-fig9", duration=20.0, steering="slalom", onset=1.0, amplitude=0.15,
    frequency=0.2, wind_force=200.0, wind_height=0.5, wind_start=8.0, wind_length=6.0, surge=0.5,
    surge_frequency=0.1, vehicle=_make_stiffness(7000.0),
    nominal={**_make_stiffness(10000.0), **_TOO_STIFF}, **(_SIMULATED | {"roll": True}),
)  # fmt: skip

SIMULATIONS = (
    _FIG7, _FIG8,
    _FIG8.replace(name="tie-vision-fig8-stiff", vehicle=_make_stiffness(7200.0)),
    _UNEVEN,
    _UNEVEN.replace(name="uneven-delay-fig5-noisy", noise={"camera_psi": 0.003, "camera_y": 0.03}),
    _DOUBLE,
    _DOUBLE.replace(name="double-layer-fig9-fast", frequency=0.4),
    _DOUBLE.replace(name="double-layer-fig9-periods", steering="double-lane-change", hold=9.0),
    _DOUBLE.replace(name="double-layer-fig9-calm", wind_force=0.0),
    _DUAL, _DAKF, _DAKF_STEP,
)  # fmt: skip

# given: a sine by the driver, 0 to 30 km/h, the filter's tyres are not the real ones
_DRIVER = Scenario(
    name="tie-vision-fig9", duration=30.0, steering="slalom", onset=3.0, amplitude=0.08,
    frequency=0.4, speed=0.0, speed_change=30.0 * KMH, change_start=1.0, change_length=20.0,
    vehicle=_make_stiffness(7200.0), **_ON_THE_ROAD,
)  # fmt: skip
# given: a lane change by a steering motor, the slip without control almost 0.03 rad
_MOTOR = Scenario(
    name="tie-vision-fig10", duration=5.0, steering="lane-change", onset=0.5, amplitude=0.108,
    frequency=0.5, vehicle=_make_stiffness(7200.0), **_ON_THE_ROAD,
)  # fmt: skip
# given: tyres 7000 against 10000, the roll model 30 % off, course and speed at 5 Hz
_DOUBLE_ROAD = Scenario(
    name="double-layer-fig9-road", duration=20.0, steering="slalom", onset=1.0, amplitude=0.1,
    frequency=0.3, vehicle=_make_stiffness(7000.0),
    nominal={**_make_stiffness(10000.0), **_TOO_STIFF}, **_ON_THE_ROAD,
)  # fmt: skip
# given: a slalom, RTK-GPS
_DUAL_ROAD = Scenario(
    name="dual-rate-fig5", duration=12.0, steering="slalom", onset=1.0, amplitude=0.1,
    frequency=0.25, gps_period=0.1, vehicle=_make_stiffness(7000.0),
    nominal=_make_stiffness(9100.0), **_ON_THE_ROAD,
)  # fmt: skip
# given: a lane change by the driver at 20 km/h, course unused 10.5-13.0 s, tyres 7000 against 10000
_DAKF_DRIVER = Scenario(
    name="dakf-fig8", duration=16.0, steering="lane-change", onset=10.0, amplitude=0.25,
    frequency=0.4, speed=20.0 * KMH, gps_outage=(10.5, 13.0), vehicle=_make_stiffness(7000.0),
    nominal=_make_stiffness(10000.0), **_ON_THE_ROAD,
)  # fmt: skip
# given: cornering by steer-by-wire at 20 km/h, tyres as in Fig. 8
_DAKF_CORNER = _DAKF_DRIVER.replace(
    name="dakf-fig9", duration=8.0, steering="step", onset=1.0, amplitude=0.1, hold=100.0,
    gps_outage=None,
)  # fmt: skip

ROAD_TESTS = (
    _DRIVER, _MOTOR,
    # given besides: 9 to 18 ms of image processing
    _DRIVER.replace(name="uneven-delay-fig7", camera_delays=(0.009,), camera_jitter=0.009),
    _DOUBLE_ROAD, _DUAL_ROAD, _DAKF_DRIVER, _DAKF_CORNER,
)  # fmt: skip
