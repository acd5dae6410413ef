"""Resets of a vector env, and arguments by row: seeds, masks, options that are each row's own."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import SyncVectorEnv

from sideslip.envs import COMS
from sideslip.estimators import EstimateObservation, vector

from ..batches import MODES, SHORT, batch, drive, pair, plain, same, same_cars, sync
from ..helpers import bits

FUSION = "sideslip/YawFusion-v0"
UNEVEN = "sideslip/YawVisionUneven-v0"
STILL = np.zeros((4, 1), np.float32)


def test_seeds_are_an_int_a_list_or_none() -> None:
    alone, together = pair(FUSION, 4)
    for seed in (7, [5, 0, 2**40, 5], [None, 3, None, 1], None):
        same(alone.reset(seed=seed), together.reset(seed=seed))  # type: ignore[arg-type]
        assert together.np_random_seed == alone.np_random_seed
        same_cars(alone, together)
        assert drive(alone, together, 20) > 0
    fresh = batch(FUSION, 4)
    assert bits(fresh.reset(seed=np.int64(7))[0]) == bits(batch(FUSION, 4).reset(seed=7)[0])
    one, other = batch(FUSION, 4), batch(FUSION, 4)
    assert bits(one.reset()[0]) != bits(other.reset()[0])  # seeded by chance
    assert len(set(one.np_random_seed)) == 4


@pytest.mark.parametrize("mode", MODES)
def test_a_masked_reset_leaves_the_other_rows_alone(mode: str) -> None:
    alone, together = pair(UNEVEN, 3, mode, camera={"phase": None})
    same(alone.reset(seed=1), together.reset(seed=1))
    for start in range(0, 80, 8):
        drive(alone, together, 8, start)
        mask = np.array([start % 16 == 0, False, True])
        options: dict[str, Any] = {"reset_mask": mask}
        if start % 24 == 0:
            options |= {"scenario": "slalom", "duration": 0.1}
        seed: Any = [start, 9, None]
        one = alone.reset(seed=seed, options=dict(options))
        held = {**options, "reset_mask": mask.copy()}
        same(one, together.reset(seed=seed, options=options))
        assert plain(options) == plain(held)  # the caller's
        same_cars(alone, together)


LISTS: list[dict[str, Any]] = [
    {"scenario": ["sine", {"base": "slalom", "speed": 6.0}, "uneven-delay-fig5", "sine"]},
    {"vehicle": ["coms", COMS.scale_stiffness(0.9), {"base": "coms", "mass": 420.0},
                 "passenger-car"]},
    {"friction": [0.9, 0.5, 0.3, 0.7]},
    {"friction": np.array([0.9, 0.5, 0.3, 0.7]), "duration": (0.05, 0.1, 0.15, 0.2)},
    {"state": [{}, {"v_y": 0.2}, {"v_x": 5.0, "gamma": 0.1}, {"y": 1.0}], "scenario": "step-steer"},
    {"friction": [0.5, None, None, None], "duration": [None, 0.1, 0.5, None]},
    {"scenario": ["tie-vision-fig7", "sine", "straight", "step-steer"], "friction": 0.6,
     "duration": 0.1},
]  # fmt: skip


def own(value: Any, i: int) -> Any:
    return value[i] if isinstance(value, list | tuple | np.ndarray) else value


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("options", LISTS, ids=str)
def test_each_row_may_have_options_of_its_own(options: dict[str, Any], mode: str) -> None:
    """Linear and full plants, roll and none, side by side; rows come back without options."""
    alone, together = pair(FUSION, 4, mode)
    obs, infos = together.reset(seed=10, options=options)
    for i, env in enumerate(alone.envs):
        mine = {name: own(value, i) for name, value in options.items()}
        told = {name: value for name, value in mine.items() if value is not None}
        alone_obs, info = env.reset(seed=10 + i, options=told)
        assert bits(alone_obs) == bits(obs[i])
        assert info == {key: infos[key][i] for key in info}
    same_cars(alone, together)
    assert drive(alone, together, 60) > 4
    assert all(each == together.config.scenario for each in together.scenario)  # all were reset


@pytest.mark.plain
def test_rows_that_are_told_the_same_share_what_is_built() -> None:
    env = batch(FUSION, 4)
    env.reset(seed=0, options={"scenario": ["sine", "slalom", "sine", "sine"]})
    built = {id(config) for config in env.configs}
    assert len(built) == 2


REFUSED: list[tuple[Any, dict[str, Any], type[Exception], str]] = [
    (1.5, {}, TypeError, "seed: an int or a list of 4, got 1.5"),
    ([1, 2], {}, ValueError, "seed: an int or a list of 4, got 2"),
    ([1, 2, 0.5, 1], {}, TypeError, "float"),
    (-2, {}, ValueError, r"rows 0, 1 \(2 of them\) would get a negative seed, -2"),
    ([1, -1, 2, 3], {}, ValueError, "row 1 would get a negative seed, -1"),
    (1, {"speed": 3.0}, ValueError, "unknown reset option speed; known: scenario, vehicle"),
    (1, {"friction": [0.5, 0.6]}, ValueError, "friction: one or a list of 4, one a row, got 2"),
    (1, {"friction": [0.5, 0.6, -1.0, 0.5]}, ValueError, "friction must be positive"),
    (1, {"scenario": ["sine", "sine", "slalon", "sine"]}, ValueError, "scenario 'slalon'"),
    (1, {"reset_mask": [True] * 4}, TypeError, "an array of bool, got list"),
    (1, {"reset_mask": np.ones(4)}, TypeError, "an array of bool, got float64"),
    (1, {"reset_mask": np.ones(3, bool)}, ValueError, r"has shape \(4,\), got \(3,\)"),
    (1, {"reset_mask": np.zeros(4, bool)}, ValueError, "resets no row"),
]


@pytest.mark.smoke
@pytest.mark.parametrize(("seed", "options", "error", "message"), REFUSED, ids=str)
def test_a_refused_reset_leaves_all_rows_running(
    seed: Any, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    env, untouched = batch(FUSION, 4, scenario=SHORT), batch(FUSION, 4, scenario=SHORT)
    for each in (env, untouched):
        each.reset(seed=0)
        each.step(STILL)
    with pytest.raises(error, match=message):
        env.reset(seed=seed, options=options)
    for _ in range(40):  # into the next episodes
        assert plain(env.step(STILL)) == plain(untouched.step(STILL))


@pytest.mark.smoke
def test_a_step_and_a_masked_reset_need_a_reset() -> None:
    env = batch(FUSION, 4)
    with pytest.raises(ResetNeeded, match=r"no episode was started: call reset\(\) first"):
        env.step(STILL)
    with pytest.raises(ResetNeeded, match="reset all rows first"):
        env.reset(options={"reset_mask": np.array([True, False, True, True])})
    env.reset(options={"reset_mask": np.ones(4, bool)})
    env.step(STILL)


SCENARIOS: list[Any] = [SHORT, {"base": "gust", "duration": 0.2}, SHORT, "car-iso-3888-1"]
CARS: list[Any] = ["coms", {"base": "coms", "mass": 420.0}, "passenger-car", "coms"]


@pytest.mark.parametrize("mode", MODES)
def test_every_row_is_the_environment_with_its_own_arguments(mode: str) -> None:
    """Over many episodes: what a row was made with outlives its resets, reset's options do not."""
    told: dict[str, Any] = {"on_bad_action": "fail", "control_period": 20}
    rows = zip(SCENARIOS, CARS, strict=True)
    makers = [lambda s=s, v=v: gym.make(FUSION, scenario=s, vehicle=v, **told) for s, v in rows]
    alone = SyncVectorEnv(makers, autoreset_mode=mode)
    together = batch(FUSION, 4, scenario=SCENARIOS, vehicle=CARS, autoreset_mode=mode, **told)
    options = {"friction": 0.4}
    same(alone.reset(seed=3, options=options), together.reset(seed=3, options=options))
    same_cars(alone, together)
    assert drive(alone, together, 300) > 60


@pytest.mark.parametrize("mode", MODES)
def test_a_limit_of_steps_is_that_of_time_limit(mode: str) -> None:
    told: dict[str, Any] = {"scenario": SHORT, "on_bad_action": "fail", "max_episode_steps": 9}
    alone, together = sync(FUSION, 4, mode, **told), batch(FUSION, 4, autoreset_mode=mode, **told)
    same(alone.reset(seed=1), together.reset(seed=1))
    assert drive(alone, together, 200) > 60


def test_estimators_work_with_a_limit_of_steps() -> None:
    told: dict[str, Any] = {"scenario": SHORT, "max_episode_steps": 5}
    env = EstimateObservation(gym.make(FUSION, **told), "exact-kf")
    cars = vector.EstimateObservation(batch(FUSION, 1, **told), "exact-kf")
    seen, together = [env.reset(seed=0)[0]], [cars.reset(seed=0)[0][0]]
    for _ in range(5):
        step, steps = env.step(np.zeros(1)), cars.step(np.zeros((1, 1), np.float32))
        seen.append(step[0])
        together.append(steps[0][0])
    assert step[3] and steps[3].all() and not step[2]
    np.testing.assert_array_equal(seen, together)
