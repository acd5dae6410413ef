"""StabilityVectorEnv: every row has the bits of the environment alone."""

import copy
import itertools
import json
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from sideslip.envs import SCENARIOS, StabilityVectorEnv

from ..batches import MODES, SHORT, actions, batch, drive, pair, plain, same, same_cars
from ..helpers import IDS, bits, unwrapped

FUSION = "sideslip/YawFusion-v0"
UNEVEN = "sideslip/YawVisionUneven-v0"


BRIEF = [
    pytest.param(*each, 0.1, 200, 60, marks=pytest.mark.smoke)
    for each in itertools.product(IDS, MODES)
]
LENGTHY = [
    pytest.param(*each, 3.0, 5_000, 50, marks=pytest.mark.long)
    for each in zip(IDS, itertools.cycle(MODES), strict=False)
]


@pytest.mark.parametrize(("name", "mode", "duration", "steps", "ends"), [*BRIEF, *LENGTHY])
def test_every_row_is_the_environment_alone(
    name: str, mode: str, duration: float, steps: int, ends: int
) -> None:
    """Observations, rewards, ends, infos, records and generators, over many episodes."""
    alone, together = pair(name, 5, mode, scenario=SHORT | {"duration": duration})
    same(alone.reset(seed=3), together.reset(seed=3))
    same_cars(alone, together)
    assert drive(alone, together, steps) > ends


@pytest.mark.long
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", IDS)
def test_worker_processes_say_the_same(name: str, mode: str) -> None:
    told: dict[str, Any] = {"scenario": SHORT, "on_bad_action": "fail"}
    together = batch(name, 2, autoreset_mode=mode, **told)
    how: dict[str, Any] = {"vectorization_mode": "async", "vector_kwargs": {"autoreset_mode": mode}}
    workers = gymnasium.make_vec("sideslip:" + name, num_envs=2, **how, **told)
    assert isinstance(workers, AsyncVectorEnv)
    try:
        same(workers.reset(seed=5), together.reset(seed=5))
        for step in range(500):
            drawn = actions(together, step)
            same(workers.step(drawn), together.step(drawn))
    finally:
        workers.close()


ARGUMENTS: list[dict[str, Any]] = [
    {"control_period": 1},
    {"control_period": 33, "scenario": "slalom"},
    {"fast": "all", "control_period": 7},
    {"reference": "limited", "vehicle": "passenger-car", "nominal": "coms"},
    {"camera": {"phase": None, "loss": 0.3, "duplicate": 0.3}, "gps": {"phase": None}},
    {"scenario": {"base": "straight", "half_width": 0.01, "wind_force": 600.0}},
    {"scenario": {"base": "tie-vision-fig7", "duration": 0.2}, "yaw_first": False},
    {"scenario": {"base": "coms-slalom", "duration": 0.7}, "reference": "lagged"},
    {"scenario": {"base": "straight", "curvature": 0.01, "curve_start": 0.0, "duration": 0.7},
     "with_map": True},
    {"scenario": {"base": "recovery", "duration": 0.7}, "reference": "lagged",
     "gps": {"phase": None}},
]  # fmt: skip


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("arguments", ARGUMENTS, ids=str)
def test_the_arguments_are_those_of_the_environment_alone(
    arguments: dict[str, Any], mode: str
) -> None:
    alone, together = pair(FUSION, 3, mode, **arguments)
    same(alone.reset(seed=1), together.reset(seed=1))
    assert drive(alone, together, 80) > 0
    assert together.control_period == arguments.get("control_period", 10)
    assert together.reference == arguments.get("reference", "model")


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_scenario_is_the_same_in_a_row(scenario: str) -> None:
    alone, together = pair(FUSION, 2, "SameStep")
    options = {"scenario": scenario, "duration": 1.0}
    one = alone.reset(seed=0, options=dict(options))
    same(one, together.reset(seed=0, options=options))
    same_cars(alone, together)
    assert drive(alone, together, 20) > 0


@pytest.mark.smoke
@pytest.mark.parametrize("mode", MODES)
def test_infos_at_the_ends_only(mode: str) -> None:
    every, ends = (
        batch(FUSION, 4, autoreset_mode=mode, info=info, scenario=SHORT, on_bad_action="fail")
        for info in ("all", "ends")
    )
    every.reset(seed=0)
    assert ends.reset(seed=0)[1] == {}
    seen = 0
    for step in range(150):
        told = actions(every, step)
        one, other = every.step(told), ends.step(told)
        assert bits(list(one[:4])) == bits(list(other[:4]))
        ended = one[2] | one[3]
        if not ended.any():
            assert other[4] == {}
            continue
        seen += 1
        if mode == "SameStep":
            assert plain(other[4]) == plain({key: one[4][key] for key in other[4]})
            assert other[4].keys() == {"final_obs", "_final_obs", "final_info", "_final_info"}
            continue
        assert other[4].keys() == one[4].keys()
        for key in (key for key in one[4] if not key.startswith("_")):
            assert bits(other[4][f"_{key}"]) == bits(ended)
            assert bits(other[4][key][ended]) == bits(one[4][key][ended])
            assert not other[4][key][~ended].any()
    assert seen > 20


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("way", ["state", "deepcopy", "pickle"])
def test_a_snapshot_continues_bit_for_bit(way: str, mode: str) -> None:
    env = batch(UNEVEN, 3, autoreset_mode=mode, scenario=SHORT, on_bad_action="fail")
    env.reset(seed=2, options={"vehicle": ["coms", "passenger-car", "coms"]})
    for step in range(14):  # the last one ends a row
        env.step(actions(env, step))
    twin: Any
    if way == "state":
        twin = batch(UNEVEN, 3, autoreset_mode=mode, scenario=SHORT, on_bad_action="fail")
        twin.set_state(env.get_state())
    else:
        twin = copy.deepcopy(env) if way == "deepcopy" else pickle.loads(pickle.dumps(env))
    assert list(twin.vehicle) == list(env.vehicle)
    assert bits(list(twin.record)) == bits(list(env.record))
    snapshot = env.get_state()
    futures: list[Any] = []
    for each in (env, twin, env):
        if len(futures) == 2:
            env.set_state(snapshot)
        steps = [plain(each.step(actions(each, step))) for step in range(60)]
        futures.append((steps, plain(each.reset())))
    assert futures[0] == futures[1] == futures[2]


def test_a_snapshot_of_another_batch_is_refused() -> None:
    env = batch(UNEVEN, 3)
    env.reset(seed=0)
    before = bits(env.get_state()["states"])
    for other, message in (
        (batch(UNEVEN, 2), "the snapshot has 2 rows of 10 ticks a step, this env 3 of 10"),
        (batch(UNEVEN, 3, control_period=5), "3 rows of 5 ticks a step, this env 3 of 10"),
        (batch("sideslip/YawGps-v0", 3), "other sensors or another observation"),
    ):
        other.reset(seed=1)
        with pytest.raises(ValueError, match=message):
            env.set_state(other.get_state())
        assert bits(env.get_state()["states"]) == before


@pytest.mark.smoke
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("mode", [*AutoresetMode, "SameStep"])
def test_spec_goes_through_json(mode: Any, count: int) -> None:
    told: dict[str, Any] = {"scenario": SHORT, "info": "ends", "vehicle": {"base": "coms"}}
    env = batch(FUSION, count, autoreset_mode=mode, **told)
    assert env.spec is not None
    assert env.spec.kwargs["autoreset_mode"] == AutoresetMode(mode).value  # a string
    text = env.spec.to_json()
    json.loads(text)
    for spec in (env.spec, EnvSpec.from_json(text)):
        again = gymnasium.make_vec(spec)
        assert isinstance(again, StabilityVectorEnv) and again.num_envs == count
        assert again.metadata["autoreset_mode"] == AutoresetMode(mode)
        assert again.spec is not None and again.spec.to_json() == text
    assert batch(FUSION, 2).metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert StabilityVectorEnv(2).spec is None


@pytest.mark.parametrize("name", IDS)
def test_spaces_and_returned_arrays_follow_gymnasium(name: str) -> None:
    env, alone = batch(name, 3, scenario=SHORT), unwrapped(name)
    assert env.layout == alone.layout and env.dt == alone.dt
    assert env.single_observation_space == alone.observation_space
    assert env.single_action_space == alone.action_space
    assert env.observation_space == batch_space(alone.observation_space, 3)
    assert env.action_space == batch_space(alone.action_space, 3)
    env.action_space.seed(0)
    kept: list[Any] = [env.reset(seed=0)]
    kept += [env.step(env.action_space.sample()) for _ in range(60)]
    held = copy.deepcopy(kept)
    env.step(env.action_space.sample())
    for one, other in zip(kept, held, strict=True):
        assert plain(one) == plain(other)  # what was returned is the caller's
        assert env.observation_space.contains(one[0])
    obs, rewards, terminated, truncated, infos = env.step(env.action_space.sample())
    assert obs.dtype == np.float32 and rewards.dtype == np.float64
    assert terminated.dtype == truncated.dtype == np.bool_
    assert rewards.shape == terminated.shape == truncated.shape == (3,)
    assert not any(np.shares_memory(infos["_t"], infos[key]) for key in infos if key != "_t")
    env.close()
    assert env.closed


@pytest.mark.plain
def test_disabled_rows_wait_for_a_reset() -> None:
    """Each row's episode is the single env's; a row that is over refuses the step of all."""
    alone, env = pair(FUSION, 3, "Disabled")
    same(alone.reset(seed=0), env.reset(seed=0))
    told = np.array([[0.1], [np.nan], [0.2]], np.float32)
    same(alone.step(told), env.step(told))
    with pytest.raises(ResetNeeded, match="over in row 1: call reset"):
        env.step(told)
    mask = np.array([False, True, False])
    same(alone.reset(options={"reset_mask": mask}), env.reset(options={"reset_mask": mask}))
    still = np.zeros((3, 1), np.float32)
    same(alone.step(still), env.step(still))
    same_cars(alone, env)


@pytest.mark.parametrize("mode", MODES)
def test_gymnasiums_vector_wrappers_go_around_it(mode: str) -> None:
    """Episode statistics are those around single environments, but for the time they took."""
    alone, together = pair(FUSION, 3, mode)
    wrapped: list[Any] = [RecordEpisodeStatistics(env) for env in (alone, together)]
    same(*(env.reset(seed=0) for env in wrapped))
    ended = 0
    for step in range(120):
        told = actions(alone, step)
        (*one, first), (*other, second) = (env.step(told) for env in wrapped)
        for infos in (first, second):
            if "episode" in infos:
                ended += infos["_episode"].sum()
                infos["episode"].pop("t")
        same((*one, first), (*other, second))
    assert ended > 20
