"""The table of an episode: nothing lost, units on everything."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pyarrow.parquet as pq
import pytest

import sideslip
from sideslip.agents import make_agent
from sideslip.agents.rollout import evaluate_episodes, iterate_steps
from sideslip.estimators import EstimateObservation


@pytest.mark.smoke
def test_rollout_has_every_signal_with_its_unit() -> None:
    env = gym.make("sideslip/YawVision-v0", scenario="lane-change")
    drive = sideslip.rollout(env, make_agent("feedforward", env), seed=1)
    assert set(drive.columns) == set(drive.units)
    assert {len(column) for column in drive.columns.values()} == {601}
    assert drive.columns["obs_steer"] == pytest.approx(drive["steer"], abs=1e-6)  # float32
    assert drive.cost == pytest.approx(drive["cost"].sum())
    assert len(drive.log.record.fast) == 6001 and drive.log.record.first == 0
    assert np.interp(3.0, drive["t"], drive["beta"]) == drive.log.truth["beta"][3000]


def test_rollout_is_reproducible_and_takes_an_id() -> None:
    one = sideslip.rollout("sideslip/YawGps-v0", seed=4)
    two = sideslip.rollout("sideslip/YawGps-v0", seed=4)
    assert all((one[name] == two[name]).all() for name in one.columns)


def test_steps_of_a_batch_are_each_rows_first_episode() -> None:
    """Cars leave their lanes one by one; the agent hears where an episode starts."""
    seen: list[np.ndarray] = []

    class Idle:
        def predict(self, obs: Any, state: Any, start: Any, **_: Any) -> tuple[Any, None]:
            seen.append(start)
            return np.zeros((len(obs), 1), np.float32), None

    options: dict[str, Any] = {"scenario": {"base": "curved-road", "duration": 9.0}}
    envs = gym.make_vec("sideslip/YawVision-v0", num_envs=3, **options)
    env = gym.make("sideslip/YawVision-v0", **options)
    drives = [sideslip.rollout(env, None, seed) for seed in (1, 2, 3)]
    reset, *steps = iterate_steps(envs, Idle(), [1, 2, 3])
    assert not np.any(reset.reward) and not reset.action.any() and reset.running.all()
    lengths = np.sum([step.running for step in steps], axis=0)
    assert lengths.tolist() == [len(drive["t"]) - 1 for drive in drives]
    assert len(set(lengths)) > 1 and len(steps) == max(lengths)
    costs = evaluate_episodes(envs, Idle(), [1, 2, 3])[0]
    assert costs == pytest.approx([drive.cost for drive in drives], rel=1e-12)
    starts = np.array(seen[: len(steps)])
    assert starts[0].all()
    for row, length in enumerate(lengths):
        assert not starts[1:length, row].any() and starts[length : length + 1, row].all()


def test_parquet_carries_units_and_pictures_are_drawn(tmp_path: Path) -> None:
    drive = sideslip.rollout("sideslip/YawVision-v0", seed=0, options={"duration": 1.0})
    drive.to_parquet(tmp_path / "drive.parquet")
    table = pq.read_table(tmp_path / "drive.parquet")
    assert table.num_rows == 101
    assert table.schema.field("yaw_moment").metadata[b"unit"] == b"N m"
    assert drive.plot().axes[0].get_ylabel() == "sideslip angle / deg"
    assert [path.name for path in tmp_path.iterdir()] == ["drive.parquet"]


def test_a_notebook_shows_a_drive_and_pandas_has_all_of_it() -> None:
    drive = sideslip.rollout("sideslip/YawVision-v0")
    picture = drive._repr_png_()
    assert picture is not None and picture.startswith(b"\x89PNG")
    table = drive.to_pandas()
    assert list(table) == list(drive.columns) and table.attrs["units"]["beta"] == "rad"
    np.testing.assert_array_equal(table["beta"], drive["beta"])


def test_the_motion_told_is_the_cars() -> None:
    """tie-vision (4)-(5): y_l integrates v (psi + beta) and looks ahead; beta = v_y / v_x."""
    env = gym.make(
        "sideslip/YawVision-v0",
        scenario={"base": "tie-vision-fig7", "duration": 2.5},
        control_period=1,
    )
    drive = sideslip.rollout(env, seed=4)
    truth = drive.log.truth
    v = 25.0 / 3.6
    np.testing.assert_allclose(truth["v_y"], truth["beta"] * truth["v_x"], rtol=1e-12, atol=1e-15)
    drift = v * (truth["psi"] + truth["beta"])
    y_cg = np.concatenate([[0.0], np.cumsum(0.5 * (drift[1:] + drift[:-1]) * 1e-3)])
    base: Any = env.unwrapped
    np.testing.assert_allclose(truth["y_l"], y_cg + base.vehicle.preview * truth["psi"], atol=1e-6)
    assert np.abs(truth["y_l"]).max() > 0.1


def test_a_rollout_of_many_cars_or_of_another_env_is_refused_in_one_line() -> None:
    many = gym.make_vec("sideslip/YawVision-v0", num_envs=2)
    for env in (many, gym.make("CartPole-v1"), "CartPole-v1", 5):
        with pytest.raises(TypeError, match=r"^rollout runs one env .*episodes runs a vector env$"):
            sideslip.rollout(env)  # type: ignore[arg-type]


def test_a_wrapper_that_changes_numbers_takes_their_names_and_leaves_the_cost() -> None:
    def make() -> Any:
        return gym.make("sideslip/YawFusion-v0", scenario="coms-slalom")

    plain = sideslip.rollout(make(), None, seed=1)
    scaled = sideslip.rollout(
        gym.wrappers.RescaleObservation(make(), np.float32(-1), np.float32(1)), None, seed=1
    )
    assert "obs_0" in scaled.units and "obs_beta_ref_mean" not in scaled.columns
    for wrap in (
        lambda env: gym.wrappers.TransformReward(env, lambda reward: max(float(reward), -0.001)),
        gym.wrappers.RecordEpisodeStatistics,
    ):
        assert sideslip.rollout(wrap(make()), None, seed=1).cost == plain.cost


def test_an_agent_of_another_full_scale_is_refused() -> None:
    env = EstimateObservation(gym.make("sideslip/YawFusion-v0"), "exact-kf")
    agent = make_agent("lqr", env)
    bare = gym.make("sideslip/YawFusion-v0")
    scaled = gym.wrappers.RescaleAction(bare, np.float32(-2.0), np.float32(2.0))
    assert "obs_gyro_mean" in sideslip.rollout(scaled).columns
    sideslip.rollout(env, make_agent("none", env), options={"vehicle": "passenger-car"})
    with pytest.raises(ValueError, match=r"full scale is .* N m, the car's 3500"):
        sideslip.rollout(env, agent, options={"vehicle": "passenger-car"})
