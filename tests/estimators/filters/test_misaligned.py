"""A camera and a steering sensor that are askew: states for them, against plant and Monte Carlo."""

import functools
import math
from typing import Any

import numpy as np

from sideslip.envs import COMS, Log
from sideslip.envs.record import FAST, PACKET, Record
from sideslip.envs.scenarios.manoeuvres import make_scenario
from sideslip.estimators import Estimator, make_estimator
from sideslip.estimators.core.memory import N_INPUTS
from sideslip.estimators.core.model import _compute_axle_force, build_model, linearise
from tests.estimators.core.test_consistency import within
from tests.estimators.core.test_wary import CAMERA as CAMERA_PLACE
from tests.estimators.core.test_wary import FROM, built, change_lane, drives, spoilt
from tests.estimators.dense import WITH_TYRES
from tests.estimators.drives import Drives, told
from tests.estimators.simulation import CAMERA

YAW, OFFSET = math.radians(0.3), math.radians(0.1)  # largest ones
SDS = {"camera_yaw_sd": YAW / math.sqrt(3.0), "steer_offset_sd": OFFSET / math.sqrt(3.0)}
GENTLE = make_scenario("tie-vision-fig7").replace(duration=30.0, amplitude=0.02, frequency=0.2)
RUNS = 24


def test_an_estimated_tyre_s_model_is_the_force_at_the_angle_less_the_offset() -> None:
    """Its value, and its slope by the offset, which is a difference of the law's. The tyre has a
    limit: a force that is linear in the slip would hide where it is expanded."""
    options = SDS | WITH_TYRES | {"inverse_friction_sd": 0.1}
    filter_ = make_estimator("exact-kf", sensors={"camera": CAMERA}, speed=7.0, **options)
    f, names, steer = filter_.filters[0], filter_.names, 0.08
    f.x[:2], f.x[names.index("steer_offset")] = (0.02, 0.3), 0.01

    def rates(offset: float) -> Any:
        turn = 0.3 / 7.0
        slips = (steer - offset - 0.02 - COMS.front_arm * turn, COMS.rear_arm * turn - 0.02)
        inverse_friction = f.x[f.tyres + 2]
        front, rear = (
            _compute_axle_force(f.stiffness[i], f.load[i], slips[i], 1.0, inverse_friction)[0]
            for i in range(2)
        )
        moment = COMS.front_arm * front - COMS.rear_arm * rear
        return np.array([(front + rear) / (COMS.mass * 7.0) - 0.3, moment / COMS.yaw_inertia])

    linearise(f, steer)
    build_model(f, 7.0, 0.0)
    behind = f.B[:2, N_INPUTS : N_INPUTS + f.n - f.dense]
    found = f.A[:2, : f.dense] @ f.x[: f.dense] + behind @ f.x[f.dense : f.n] + f.push[:2]
    np.testing.assert_allclose(found + f.B[:2, 0] * steer, rates(0.01), rtol=1e-12)
    slope = (rates(0.01 + 1e-5) - rates(0.01 - 1e-5)) / 2e-5
    np.testing.assert_allclose(behind[:, names.index("steer_offset") - f.dense], slope, rtol=1e-8)


def test_a_standing_car_tells_nothing_of_its_steering() -> None:
    """Its wheels turn and it does not; the offset stays as uncertain, however slowly it stopped."""
    fast = np.zeros((6000, len(FAST)))
    fast[:, FAST.steer] = 0.2
    wheels = np.maximum(1.53 - 1e-4 * np.arange(6000), 0.0)
    fast[:, FAST.wheel_left] = fast[:, FAST.wheel_right] = wheels
    filter_ = make_estimator("exact-kf", sensors={"camera": CAMERA}, **SDS)
    filter_.run(Record(fast, np.zeros((0, 11))))
    i, f = filter_.names.index("steer_offset"), filter_.filters[0]
    assert f.model_speed < 1.51 and not f.G[: f.dense, i].any()


@functools.cache
def made() -> tuple[Drives, list[Log]]:
    drives = Drives(GENTLE)
    return drives, [drives.run(seed) for seed in range(RUNS)]


def misalign(log: Log, seed: int, car: Any) -> tuple[Log, np.ndarray]:
    """The log of a car whose camera and steering sensor are askew, and yaw and offset (rad)."""
    askew = np.random.default_rng(seed).uniform(-1.0, 1.0, 2) * (YAW, OFFSET)
    fast, packets = log.record.fast.copy(), log.record.packets.copy()
    fast[:, FAST.steer] += askew[1]
    camera = packets[:, PACKET.sensor] == 0
    packets[camera, PACKET.value] += askew[0]
    packets[camera, PACKET.value + 1] += askew[0] * car.preview
    return Log(Record(fast, packets), log.slow, log.truth), askew


def judge(logs: list[Log], drives: Drives, **options: Any) -> tuple[float, float, Estimator]:
    """NEES of beta and psi at the ends, RMSE of beta from 2 s on (rad), and the filter."""
    start = dict.fromkeys(("beta", "gamma", "psi", "y_l"), 0.0)
    common: Any = {"vehicle": drives.vehicle, "sensors": told(logs[0], "camera", "gps")}
    filter_ = make_estimator(
        "exact-kf", slow=["camera", "gps"], speed=drives.speed, prior=start, **common, **options
    )
    nees, squares = [], []
    for log in logs:
        found = filter_.run(log)
        error = found.x[:, [0, 2]] - np.column_stack([log.truth["beta"], log.truth["psi"]])
        nees.append(error[-1] @ np.linalg.solve(filter_.P[np.ix_([0, 2], [0, 2])], error[-1]) / 2.0)
        squares.append(np.mean(error[2000:, 0] ** 2))
    return float(np.mean(nees)), math.sqrt(np.mean(squares)), filter_


def test_with_states_a_misaligned_car_is_estimated_as_well_as_a_clean_one() -> None:
    """And without them the filter is overconfident: 30 s of gentle steering."""
    drives, clean = made()
    askew = [misalign(log, seed, drives.vehicle)[0] for seed, log in enumerate(clean)]
    low, high = within(2 * RUNS)
    best, plain, ours = judge(clean, drives), judge(askew, drives), judge(askew, drives, **SDS)
    for label, (nees, rmse, _) in {"clean": best, "without": plain, "with": ours}.items():
        print(f"{label}: NEES {nees:.2f}, RMSE of beta {1e3 * rmse:.3f} mrad")
    assert low < best[0] < high and low < ours[0] < high
    assert ours[1] < 1.03 * best[1] < plain[1]
    assert plain[0] > 5.0


def test_yaw_and_offset_are_found_within_their_deviations() -> None:
    drives, clean = made()
    squares = []
    for seed, log in enumerate(clean):
        changed, askew = misalign(log, seed, drives.vehicle)
        filter_ = judge([changed], drives, **SDS)[2]
        at = [filter_.names.index(name) for name in ("camera_yaw", "steer_offset")]
        sd = np.sqrt(np.diag(filter_.P))[at]
        squares.append(((filter_.x[at] - askew) / sd) ** 2)
        assert (sd < [0.2 * YAW, 0.2 * OFFSET]).all()
    low, high = within(RUNS)
    assert ((low < np.mean(squares, 0)) & (np.mean(squares, 0) < high)).all()


def test_a_lane_change_is_not_taken_for_a_yaw_of_the_camera() -> None:
    """Where a sensor is believed again, what is forgotten is y_l, and not how it is mounted."""
    base, logs = drives("camera")
    filter_ = built(base, logs[0], camera_yaw_sd=0.005)
    i, lane = filter_.names.index("camera_yaw"), spoilt(logs[0], change_lane, CAMERA_PLACE)
    found = filter_.run(lane)
    assert filter_.counts["gated"] > 0
    assert found.std[FROM:, i].max() <= found.std[FROM - 1, i]
