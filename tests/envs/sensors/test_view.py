"""The camera's field of view: beyond it a packet is there, and nobody uses it."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.envs.record import PACKET, Record, concatenate
from sideslip.estimators import make_estimator

FUSION = "sideslip/YawFusion-v0"
TURN = {"base": "sine", "steering": "held-step", "onset": 0.2, "amplitude": 0.06, "duration": 3.0}
HEADING, OFFSET = 0.3, 1.5


def drive(view: Any, steps: int = 250, **arguments: Any) -> Any:
    """The record of a turn off a straight road, its observations by name and its infos."""
    env: Any = gym.make(FUSION, scenario=TURN | view, **arguments)
    names = [entry.name for entry in env.get_wrapper_attr("layout")]
    obs, info = env.reset(seed=3)
    records, seen, infos = [env.unwrapped.record], [obs], [info]
    for _ in range(steps):
        obs, _, _, _, info = env.step(np.zeros(1, np.float32))
        records.append(env.unwrapped.record)
        seen.append(obs)
        infos.append(info)
    table = dict(zip(names, np.array(seen).T, strict=True))
    return concatenate(records), table, infos, env.unwrapped.slow_sensors


@pytest.mark.parametrize("view", [{"camera_heading": HEADING}, {"camera_offset": OFFSET}])
def test_quality_is_0_beyond_the_view_and_1_within(view: Any) -> None:
    """Heading and offset are the truth's; the fusion id's first tick has a straight road."""
    every: dict[str, Any] = {"camera": {"period": 0.01, "delays": (0.0,)}}
    record, _, infos, _ = drive(view, **every)
    free, _, _, _ = drive({}, **every)
    np.testing.assert_array_equal(record.fast, free.fast)
    packets = record.select_packets("camera")
    psi = np.array([info["psi"] for info in infos])
    quality = packets[:, PACKET.quality]
    if "camera_heading" in view:
        np.testing.assert_array_equal(quality, np.abs(psi) <= HEADING)
    else:
        y = packets[:, PACKET.value + 1] - 5.135 * psi  # with 20 mm of noise
        sure = np.abs(np.abs(y) - OFFSET) > 0.1
        np.testing.assert_array_equal(quality[sure], (np.abs(y) <= OFFSET)[sure])
    assert 0.1 < quality.mean() < 0.9
    np.testing.assert_array_equal(packets[:, PACKET.value :], free.select_packets("camera")[:, 5:])


def test_the_observation_holds_the_newest_sample_of_quality_1() -> None:
    record, seen, _, _ = drive({"camera_heading": HEADING})
    good = [p for p in record.select_packets("camera") if p[PACKET.quality] > 0.0]
    last = good[-1]
    assert last[PACKET.arrived] < 2000
    assert seen["camera_psi"][-1] == np.float32(last[PACKET.value])
    age = (len(record.fast) - 1 - last[PACKET.captured]) * 1e-3
    names = [name for name in seen if name.startswith("camera")]
    assert seen[names[2]][-1] == pytest.approx(age, abs=1e-6)
    assert not seen[names[3]][-20:].any()  # fresh


@pytest.mark.parametrize("delay", ["clone", "buffer"])
def test_a_filter_counts_it_and_is_where_it_would_be_without(delay: str) -> None:
    record, _, _, sensors = drive({"camera_heading": HEADING})
    good = record.packets[record.packets[:, PACKET.quality] > 0.0]
    filter_ = make_estimator("exact-kf", sensors=sensors, slow=["camera", "gps"], delay=delay)
    ends = []
    for packets in (record.packets, good):
        found = filter_.run(Record(record.fast, packets))
        ends.append((found.x[-1].copy(), filter_.P.copy()))
        assert filter_.counts["poor"] == len(packets) - len(good)
    for one, other in zip(*ends, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_scenario_loses_frames() -> None:
    record, _, _, sensors = drive({"camera_loss": 0.3})
    whole, _, _, _ = drive({})
    share = len(record.select_packets("camera")) / len(whole.select_packets("camera"))
    assert sensors["camera"].loss == 0.3 and 0.5 < share < 0.9
    assert len(record.select_packets("gps")) == len(whole.select_packets("gps"))
    assert drive({}, 1, camera={"loss": 0.2})[3]["camera"].loss == 0.2  # the id's stands
