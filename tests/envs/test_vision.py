"""`vision="image"`: packets from pictures of the true road, where and when they are taken."""

import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("cv2")
import sideslip
from sideslip.envs.record import PACKET, Record, concatenate
from sideslip.envs.sensors.camera.images import Pinhole, RoadRenderer
from sideslip.envs.sensors.slow import Detector, load_detector
from sideslip.estimators import EstimateObservation

assert sideslip.__version__
ID, FUSION = "sideslip/YawVision-v0", "sideslip/YawFusion-v0"
BEND = {"base": "curved-road-driver", "duration": 2.0, "curve_start": -40.0}
EXACT = BEND | {"noise": {"camera_psi": 0.0, "camera_y": 0.0}}
IMAGE = {"vision": "image", "delay": "link"}
VALUE = slice(PACKET.value, PACKET.value + 2)


def made(env_id: str = ID, scenario: Any = BEND, **arguments: Any) -> Any:
    return gym.make(env_id, scenario=scenario, **arguments)


def drive(env: Any, steps: int = 25, seed: int = 4) -> tuple[Record, list[Any]]:
    """The record and the observations of a drive, in order."""
    observations = [env.reset(seed=seed)[0]]
    records = [env.unwrapped.record]
    for _ in range(steps):
        observations.append(env.step(np.full(env.action_space.shape, 0.1, np.float32))[0])
        records.append(env.unwrapped.record)
    return concatenate(records), observations


@pytest.fixture(scope="module")
def fitted() -> Record:
    """A drive of 0.4 s with delays from the file."""
    return drive(made(vision="image"), 40)[0]


def test_a_picture_is_taken_from_the_height_that_the_world_drew() -> None:
    """It is that of a camera mounted there, of which the lane finder is not told."""
    env = made(vision="image", delay="link", world={"camera_height": 0.05})
    camera = env.unwrapped.camera
    renderer, pictures = camera.renderer, []

    def render(scene: Any, seed: Any) -> Any:
        pictures.append((scene, seed))
        return renderer.render_picture(scene, seed)

    camera.renderer = SimpleNamespace(render_picture=render)
    drive(env, 4)
    low = replace(Pinhole(), height=Pinhole().height * (1.0 / 1.05))
    assert pictures and camera.finder.camera == Pinhole()
    scene, seed = pictures[-1]
    expected = RoadRenderer(low, renderer.appearance, camera.finder.rows)
    picture = expected.render_picture(scene._replace(height=1.0), seed)
    np.testing.assert_array_equal(camera.picture, picture)


@pytest.mark.parametrize("env_id", [ID, "sideslip/YawVisionUneven-v0", FUSION])
def test_only_the_cameras_values_differ_from_the_analytic_cameras(env_id: str) -> None:
    """With the camera's own link: same ticks, same GPS, values near the truth."""
    exact, _ = drive(made(env_id, EXACT))
    seen, _ = drive(made(env_id, vision="image", delay="link"))
    np.testing.assert_array_equal(seen.fast, exact.fast)
    for part in (slice(PACKET.quality), slice(PACKET.sequence, PACKET.value)):
        np.testing.assert_array_equal(seen.packets[:, part], exact.packets[:, part])
    np.testing.assert_array_equal(seen.select_packets("gps"), exact.select_packets("gps"))
    found, truth = seen.select_packets("camera"), exact.select_packets("camera")
    assert len(found) >= 7 and (found[:, PACKET.quality] > 0.5).all()
    assert np.abs(truth[:, PACKET.value + 1]).max() > 0.2  # a wrong sign would show
    error = np.abs(found - truth)[:, VALUE]
    assert error[:, 0].max() < 0.01 and error[:, 1].max() < 0.08
    assert error.any(0).all()


@pytest.mark.parametrize("period", [1, 50])
def test_the_record_is_the_same_for_every_control_period(period: int, fitted: Record) -> None:
    """A frame may arrive in the step in which it was taken."""
    other, _ = drive(made(vision="image", control_period=period), 200 // period)
    np.testing.assert_array_equal(other.fast, fitted.fast[:201])
    first = fitted.packets[fitted.packets[:, PACKET.arrived] <= 200]
    assert len(first) > 3
    np.testing.assert_array_equal(other.packets, first)


def test_delays_are_drawn_from_the_file_by_the_key(fitted: Record) -> None:
    packets = fitted.select_packets("camera")
    late = packets[:, PACKET.arrived] - packets[:, PACKET.captured]
    sensor = made(vision="image").unwrapped.slow_sensors["camera"]
    assert len(set(late)) > 2
    assert late.min() >= round(1e3 * sensor.delays[0])
    assert late.max() <= np.ceil(1e3 * sensor.longest_delay)
    other = drive(made(vision="image"), 20, 5)[0].select_packets("camera")
    assert (other[:, 2] != packets[: len(other), 2]).any()


def test_the_distribution_on_file() -> None:
    on_file = load_detector()
    shares = np.linspace(0.001, 0.999, 99)
    times = np.array([on_file.compute_delay(share) for share in shares])
    assert (np.diff(times) >= 0.0).all()
    assert times[0] >= on_file.range[0] and times[-1] <= on_file.range[1] < 0.033
    slow = Detector(0.01, np.log(0.005), 0.5, (0.0, 1.0), {})
    assert slow.compute_delay(0.5) == pytest.approx(0.015)


def test_a_snapshot_and_a_copy_continue_bit_for_bit() -> None:
    env = made(vision="image")
    drive(env, 5)
    twin, snapshot = copy.deepcopy(env), env.unwrapped.get_state()
    ends: list[Any] = []
    for each in (env, twin, env):
        if ends and each is env:
            env.unwrapped.set_state(snapshot)
        ends.append([each.step(np.zeros(1, np.float32))[0] for _ in range(6)])
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])


def test_its_spec_comes_back_and_filters_take_it() -> None:
    noisy = made(FUSION, vision="image", appearance={"noise": 4.0})
    env: Any = EstimateObservation(noisy, "exact-kf")
    one, seen = drive(env, 6)
    other, again = drive(gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json())), 6)
    np.testing.assert_array_equal(one.packets, other.packets)
    np.testing.assert_array_equal(seen, again)
    assert env.unwrapped.scenario.noise.items() >= load_detector().noise.items()
    assert not env.spec.nondeterministic and "nondeterministic" not in env.reset(seed=0)[1]


def test_a_measured_delay_makes_it_nondeterministic() -> None:
    env = made(vision="image", delay="measured")
    record, _ = drive(env, 15)
    packets = record.select_packets("camera")
    late = packets[:, PACKET.arrived] - packets[:, PACKET.captured]
    assert (late >= 1).all() and (late <= 100).all()
    assert env.spec.nondeterministic and env.unwrapped.metadata["nondeterministic"]
    assert env.step(np.zeros(1, np.float32))[4]["nondeterministic"] is True


def test_a_road_without_paint_and_a_lane_out_of_view_are_quality_0() -> None:
    for scenario, look in ((BEND, {"wear": 1.0}), (BEND | {"camera_offset": 1e-3}, {})):
        env = made(scenario=scenario, vision="image", appearance=look)
        record, observations = drive(env, 12)
        packets = record.select_packets("camera")
        assert len(packets) and not packets[:, PACKET.quality].any() and not packets[:, VALUE].any()
        names = [entry.name for entry in env.unwrapped.layout]
        assert not observations[-1][names.index("camera_fresh")]


def test_the_newest_picture_is_there_and_no_vector_engine_takes_it() -> None:
    env = made(vision="image")
    drive(env, 1)
    camera = env.unwrapped.camera
    assert camera.picture.shape == (720, 1280) and camera.lane.quality > 0.5
    with pytest.raises(ValueError, match="vectorization_mode='sync'"):
        gym.make_vec(ID, 2, vision="image")
    rows: Any = gym.make_vec(ID, 2, vectorization_mode="sync", scenario=BEND, vision="image")
    rows.reset(seed=4)
    rows.step(np.full((2, 1), 0.1, np.float32))
    env.reset(seed=4)
    env.step(np.full(1, 0.1, np.float32))
    first = rows.envs[0].unwrapped.record
    np.testing.assert_array_equal(first.packets, env.unwrapped.record.packets)


REFUSED: list[tuple[str, dict[str, Any], type[Exception], str]] = [
    (ID, {"vision": "film"}, ValueError, "unknown vision 'film'"),
    (ID, {"delay": "fitted"}, ValueError, "delay='fitted' is of pictures"),
    (ID, {"appearance": {}}, ValueError, "appearance is of pictures"),
    (ID, {"vision": "image", "delay": "late"}, ValueError, "unknown delay 'late'"),
    (ID, IMAGE | {"appearance": {"wear": 2.0}}, ValueError, "shadow and wear are shares"),
    (ID, IMAGE | {"camera": {"delays": [0.0]}}, ValueError, "a picture takes a tick at least"),
    (ID, IMAGE | {"appearance": {"ware": 0.1}}, TypeError, "appearance: unknown option 'ware'; did"
     " you mean 'wear'"),
    ("sideslip/YawGps-v0", {"vision": "image"}, ValueError, "needs a camera"),
]  # fmt: skip


@pytest.mark.parametrize(("env_id", "arguments", "error", "said"), REFUSED, ids=str)
def test_what_is_out_of_place_is_named(
    env_id: str, arguments: dict[str, Any], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        made(env_id, **arguments)
