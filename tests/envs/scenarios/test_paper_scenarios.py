"""The papers' simulations as docs/reference/papers.md gives them, and the twins of road tests."""

import math
from typing import Any

import numpy as np
import pytest

from sideslip.envs import COMS, SCENARIOS, StabilityEnv
from sideslip.envs.engine.layout import Z
from sideslip.envs.record import PACKET
from sideslip.envs.scenarios.manoeuvres import ROAD_TESTS, SIMULATIONS

Fields = dict[str, Any]
OURS = [scenario.name for scenario in SIMULATIONS]
TWINS = [scenario.name for scenario in ROAD_TESTS]
TYRES = ("front_stiffness", "rear_stiffness")
ROLL = ("roll_inertia", "roll_damping", "roll_stiffness")  # double-layer-gps (43)


def fields(steering: str, amplitude: float, hertz: float, onset: float, **more: Any) -> Fields:
    shape = {"steering": steering, "amplitude": amplitude, "frequency": hertz, "onset": onset}
    return shape | more


WIND: Fields = {"wind_force": 200.0, "wind_arm": 0.2, "wind_start": 4.0, "wind_length": 4.0}
BLOWN = {"wind_force": 200.0, "wind_height": 0.5, "wind_start": 8.0, "wind_length": 6.0}
SURGE: Fields = {"surge": 0.5, "surge_frequency": 0.1, "roll": True}
SINE = fields("sine", 0.1, 0.5, 0.0, duration=10.0)
FIG8 = fields("lane-change", 0.13, 0.5, 0.5, duration=5.0)
UNEVEN = SINE | {"camera_delays": (0.020, 0.015, 0.010, 0.025)}
DAKF = fields("lane-change", 0.2, 0.2, 0.5, duration=10.0, gps_outage=(4.0, 6.0)) | WIND
STEP: Fields = WIND | {"steering": "step", "amplitude": 0.06, "onset": 1.0, "gps_outage": None}
DUAL = WIND | fields("slalom", 0.1, 0.25, 1.0, duration=12.0, wind_arm=0.0, gps_period=0.1)
DOUBLE = fields("slalom", 0.15, 0.2, 1.0, duration=20.0, **SURGE)
PERIODS = DOUBLE | BLOWN | {"steering": "double-lane-change", "hold": 9.0}


def noise(psi: float, y: float) -> dict[str, float]:
    return {"camera_psi": psi, "camera_y": y}


# docs/reference/papers.md: fields, real tyres, nominal tyres, OU, noise
TABLE: dict[str, tuple[Fields, float, float, bool, dict[str, float]]] = {
    "tie-vision-fig7": (SINE, 7200.0, 6000.0, True, {}),
    "tie-vision-fig8": (FIG8, 6000.0, 6000.0, False, noise(0.0005, 0.003)),
    "tie-vision-fig8-stiff": (FIG8, 7200.0, 6000.0, False, noise(0.0005, 0.003)),
    "uneven-delay-fig5": (UNEVEN, 7200.0, 6000.0, False, noise(0.001, 0.01)),
    "uneven-delay-fig5-noisy": (UNEVEN, 7200.0, 6000.0, False, noise(0.003, 0.03)),
    "dakf-fig6": (DAKF, 7000.0, 10000.0, True, {}),
    "dakf-fig7": (STEP | {"lags": True, "duration": 10.0}, 7000.0, 10000.0, True, {}),
    "dual-rate-fig4": (DUAL, 7000.0, 9100.0, True, {}),
    "double-layer-fig9": (DOUBLE | BLOWN, 7000.0, 10000.0, True, {}),
    "double-layer-fig9-fast": (DOUBLE | BLOWN | {"frequency": 0.4}, 7000.0, 10000.0, True, {}),
    "double-layer-fig9-periods": (PERIODS, 7000.0, 10000.0, True, {}),
    "double-layer-fig9-calm": (DOUBLE, 7000.0, 10000.0, True, {}),
}


@pytest.mark.plain
def test_every_paper_simulation_stands_in_the_table() -> None:
    assert set(TABLE) == set(OURS)
    fixed = {name for name, each in SCENARIOS.items() if not each.mirror}
    assert fixed == {*OURS, *TWINS}


@pytest.mark.plain
@pytest.mark.smoke
@pytest.mark.parametrize("name", TABLE)
def test_papers_simulations_are_as_PAPERS_gives_them(name: str) -> None:
    expected, real, told, disturbed, noises = TABLE[name]
    scenario = SCENARIOS[name]
    for field, value in expected.items():
        assert getattr(scenario, field) == value, field
    rolls = "double-layer" in name
    assert scenario.speed == 25.0 / 3.6
    assert scenario.held_speed == (None if rolls else 25.0 / 3.6)
    assert (scenario.small_angle, scenario.tyres, scenario.roll) == (True, "linear", rolls)
    assert scenario.lags == expected.get("lags", False)
    assert (scenario.hdop, scenario.hdop_spread, scenario.hdop_law) == (1.0, 0.0, "constant")
    names = ("disturbance_force", "disturbance_moment", "disturbance_time")
    acting = (50.0, 20.0, 0.3) if disturbed else (0.0, 0.0, 0.3)
    assert tuple(getattr(scenario, each) for each in names) == acting
    assert dict(scenario.noise) == noises
    assert scenario.wind_force == expected.get("wind_force", 0.0)
    np.testing.assert_array_equal(*scenario.get_draw_ranges())  # nothing is drawn
    env = StabilityEnv("fusion", scenario=name)
    for seed in (0, 1):
        env.reset(seed=seed)
        assert [getattr(env.vehicle, tyre) for tyre in TYRES] == [real, real]
        assert [getattr(env.nominal, tyre) for tyre in TYRES] == [told, told]
        rest = {"front_stiffness": 6000.0, "rear_stiffness": 6000.0}
        if name == "dakf-fig7":  # the EPS lags, the motors do not
            assert (env.vehicle.motor_lag, env.vehicle.steering_lag) == (0.0, 0.03)
            rest["motor_lag"] = COMS.motor_lag
        assert env.vehicle.replace(**rest) == COMS
        soft = {each: 1.3 * getattr(COMS, each) for each in ROLL} if rolls else {}
        assert env.nominal == COMS.replace(front_stiffness=told, rear_stiffness=told, **soft)
        assert env.packed_state[Z.clock.redraws] == 0


def uncontrolled(name: str, seed: int = 0) -> tuple[StabilityEnv, Any, Any]:
    """(env at the end, times and true motions with beta at each step, packets)."""
    env = StabilityEnv("fusion", scenario=name)
    env.reset(seed=seed)
    over, seen, packets = False, [], []
    while not over:
        _, _, failed, over, info = env.step(np.zeros(1, np.float32))
        assert not failed
        seen.append((info["t"], info["beta"], *env.motion))
        packets.append(env.record.packets)
    return env, np.array(seen), np.concatenate(packets)


@pytest.mark.parametrize("name", TWINS)
def test_twins_of_road_tests_drive_the_whole_plant(name: str) -> None:
    scenario = SCENARIOS[name]
    assert not (scenario.small_angle or scenario.tyres == "linear" or scenario.tier)
    assert scenario.lags
    assert scenario.roll
    assert scenario.hdop_law == "half"
    np.testing.assert_array_equal(*scenario.get_draw_ranges())
    _, seen, _ = uncontrolled(name)
    assert seen[-1, 0] == scenario.duration
    assert np.abs(seen[:, 1]).max() > 0.01  # the slip is worth an estimate
    assert np.abs(seen[:, 11]).max() > 0.01  # the body rolls


@pytest.mark.parametrize("name", ["tie-vision-fig9", "uneven-delay-fig7"])
def test_the_driver_goes_from_standstill_to_30_kmh(name: str) -> None:
    v_x = uncontrolled(name)[1][:, 2] * 3.6
    assert abs(v_x[50]) < 1e-3  # the side force of 50 N hardly rolls a standing car
    assert v_x[-1] == pytest.approx(30.0, abs=0.2)  # the turns brake it a little
    assert np.diff(v_x[150:2000]).min() > 0.0


def test_the_steering_motors_lane_change_has_a_slip_of_almost_3_hundredths() -> None:
    peaks = [np.abs(uncontrolled("tie-vision-fig10", seed)[1][:, 1]).max() for seed in range(9)]
    assert np.median(peaks) == pytest.approx(0.03, abs=0.002)


def test_image_processing_takes_9_to_18_ms() -> None:
    packets = uncontrolled("uneven-delay-fig7")[2]
    camera = packets[packets[:, PACKET.sensor] == 0.0]
    late = camera[:, PACKET.arrived] - camera[:, PACKET.captured]
    assert set(late.tolist()) == set(range(9, 19))


def test_the_course_is_unused_from_10_5_to_13_s() -> None:
    _, seen, packets = uncontrolled("dakf-fig8")
    gps = packets[packets[:, PACKET.sensor] == 1.0, PACKET.captured] * 0.001
    assert not np.any((gps >= 10.5) & (gps < 13.0))
    assert {10.4, 13.0} <= set(gps.round(3))
    assert seen[:, 2].mean() * 3.6 == pytest.approx(20.0, abs=0.2)
    during = (seen[:, 0] > 10.5) & (seen[:, 0] < 13.0)
    assert np.abs(seen[during, 1]).max() == np.abs(seen[:, 1]).max()  # the lane change


@pytest.mark.parametrize("name", ["dual-rate-fig4", "dual-rate-fig5"])
def test_course_comes_at_10_hz(name: str) -> None:
    env, _, packets = uncontrolled(name)
    gps = packets[packets[:, PACKET.sensor] == 1.0]
    assert set(np.diff(gps[:, PACKET.captured])) == {100.0}
    assert env.slow_sensors["gps"].period == 0.1


def test_the_driver_of_the_double_layer_simulation_surges() -> None:
    _, seen, _ = uncontrolled("double-layer-fig9-calm")
    rate = math.tau * 0.1
    wanted = 25.0 / 3.6 + 0.5 / rate * (1.0 - np.cos(rate * seen[:, 0]))
    # PI of 2 / s against the turns' gamma v_y
    turning = np.abs(seen[:, 4] * seen[:, 3]).max()
    assert np.abs(seen[:, 2] - wanted).max() < turning / 2.0 < 0.5
    lean = seen[:, 11]
    assert 0.05 < np.abs(lean).max() < 0.2
