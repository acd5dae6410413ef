"""The vector EstimateObservation has the bits of the single one, around either vector env."""

import copy
import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector.utils import batch_space

from sideslip.envs import COMS
from sideslip.estimators import FILTERS
from sideslip.estimators.vector.estimate import EstimateObservation
from sideslip.estimators.wrappers.estimate import EstimateObservation as Single
from tests.envs import batches
from tests.envs.batches import actions, same
from tests.envs.helpers import IDS
from tests.estimators.vector.fleets import (
    BAD,
    MODES,
    UNEVEN,
    VISION,
    drive_both,
    home,
    outputs,
    pair,
)

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")


def wrap_both(env_id: str, count: int, mode: str, layers: list[Any], **kwargs: Any) -> Any:
    """Around SyncVectorEnv, and around the vector env."""
    both = batches.pair(env_id, count, mode, **kwargs)
    return [EstimateObservation(env, **layers[0]) for env in both]


QUICK = ("exact-kf", "course-kf")
SLOW = [pytest.param(wrap_both, name, marks=pytest.mark.long) for name in FILTERS]
CASES: list[Any] = [(pair, name) for name in FILTERS] + [(wrap_both, name) for name in QUICK]
CASES += [case for case in SLOW if case.values[1] not in QUICK]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("make", "name"), CASES)
def test_every_row_is_the_environment_wrapped_alone(make: Any, name: Any, mode: Any) -> None:
    """Observations, rewards, ends and infos, with `final_obs`, over several episodes."""
    env_id, sensor = home(name)
    layer = {"estimator": name, "outputs": outputs(name)}
    alone, together = make(env_id, 3, mode, [layer], **{sensor: {"phase": None, "loss": 0.2}})
    assert drive_both(alone, together, 25 if make is pair else 60, seed=[11, 5, 7]) > 3


@pytest.mark.smoke
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("count", [1, 8])
def test_own_covariance_where_arrivals_differ(count: Any, mode: Any) -> None:
    """Delays with jitter, an int as seed, other outputs."""
    layer = {"estimator": "exact-kf", "outputs": ["y_l", "gamma"], "replace": True}
    alone, together = pair(UNEVEN, count, mode, [layer], camera={"phase": None})
    assert drive_both(alone, together, 40, seed=3) > 0
    assert count == 1 or len({each.P.tobytes() for each in together.estimator}) > 4


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("control_period", "steps"), [(1, 130), (33, 15)])
def test_other_control_periods(control_period: int, steps: int, mode: Any) -> None:
    layers = [{"estimator": "multirate-kf"}]
    both = pair(VISION, 2, mode, layers, control_period=control_period)
    assert drive_both(*both, steps, seed=3) > 1


@pytest.mark.parametrize("mode", MODES)
def test_rows_may_be_different_cars(mode: Any) -> None:
    """Own nominal vehicle, own plant with a held speed, own delays: filters of three designs."""
    changes: list[dict[str, Any]] = [
        {"nominal": COMS.scale_stiffness(0.8).to_dict()},
        {"scenario": {"base": "tie-vision-fig7", "duration": 0.15}},
        {"scenario": {"base": "uneven-delay-fig5", "duration": 0.1}},
    ]
    alone, together = pair(VISION, 4, mode, [{"estimator": "multirate-kf"}], changes=changes)
    assert drive_both(alone, together, 30, seed=3) > 3
    tables = [each.gains for each in together.estimator]
    assert np.shares_memory(tables[0], tables[3]) and not np.shares_memory(tables[0], tables[1])


@pytest.mark.parametrize("mode", MODES)
def test_a_masked_reset_leaves_the_other_rows_alone(mode: Any) -> None:
    alone, together = pair(UNEVEN, 3, mode, [{"estimator": "exact-kf"}])
    same(alone.reset(seed=1), together.reset(seed=1))
    for start in range(0, 40, 8):
        drive_both(alone, together, 8, start)
        mask = np.array([start % 16 == 0, False, True])
        one = alone.reset(seed=[start, None, 4], options={"reset_mask": mask.copy()})
        other = together.reset(seed=[start, None, 4], options={"reset_mask": mask.copy()})
        same(one, other)


@pytest.mark.parametrize("mode", MODES)
def test_several_estimators_stand_side_by_side(mode: Any) -> None:
    layers: list[dict[str, Any]] = [
        {"estimator": "bicycle-kf", "name": "plain", "outputs": ["gamma"]},
        {"estimator": "exact-kf", "std": False, "vehicle": COMS.scale_stiffness(1.2)},
        {"estimator": "multirate-kf", "name": "last", "outputs": ["psi"]},
    ]
    alone, together = pair(VISION, 2, mode, layers)
    assert together.layout == alone.envs[0].layout
    assert drive_both(alone, together, 30, seed=1) > 3
    drawn = [each.unwrapped.annotations for each in alone.envs]
    assert [each.unwrapped.annotations for each in together.unwrapped.envs] == drawn
    infos = together.step(actions(together, 0))[-1]
    assert "plain_nees" in infos and "last_beta_hat" in infos and "last_nees" not in infos
    with pytest.raises(ValueError, match=r"last_psi_hat.* would stand twice; give"):
        EstimateObservation(together, "exact-kf", outputs=["psi"], name="last")


@pytest.mark.smoke
def test_layout_and_spaces_describe_the_observations() -> None:
    env: Any = gym.make_vec(VISION, num_envs=2, vectorization_mode="sync")
    together = EstimateObservation(env, "multirate-kf", outputs=["beta", "y_l"])
    alone: Any = Single(gym.make(VISION), "multirate-kf", outputs=["beta", "y_l"])
    assert together.layout == alone.layout
    assert together.single_observation_space == alone.observation_space
    assert together.observation_space == batch_space(alone.observation_space, 2)
    obs, _ = together.reset(seed=0)
    assert together.observation_space.contains(obs)
    held = obs.copy()
    stepped = together.step(np.zeros((2, 1), np.float32))[0]
    assert together.observation_space.contains(stepped)
    np.testing.assert_array_equal(obs, held)  # what was returned is the caller's


@pytest.mark.parametrize("options", [{}, {"latency": {"gyro": 0.005}}])
def test_copies_continue_bit_for_bit(options: dict[str, Any]) -> None:
    _, env = pair(UNEVEN, 3, "SameStep", [{"estimator": "exact-kf", "options": options}])
    env.reset(seed=2)
    for step in range(8):
        env.step(actions(env, step))
    twin = copy.deepcopy(env)
    assert drive_both(env, twin, 12, 8) > 2


@pytest.mark.long
@pytest.mark.parametrize(("env_id", "mode"), [*zip(IDS, itertools.cycle(MODES), strict=False)])
def test_so_it_does_over_many_episodes(env_id: str, mode: str) -> None:
    name = "course-kf" if env_id == "sideslip/YawGps-v0" else "multirate-kf"
    alone, together = wrap_both(env_id, 5, mode, [{"estimator": name}])
    assert drive_both(alone, together, 5_000, seed=1) > 50


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("make", [pair, wrap_both])
def test_masks_and_other_scenarios_tell_the_filters(make: Any, mode: str) -> None:
    alone, together = make(VISION, 3, mode, [{"estimator": "multirate-kf"}])
    same(alone.reset(seed=1), together.reset(seed=1))
    for k, scenario in enumerate(("uneven-delay-fig5", "tie-vision-fig7", "sine")):
        drive_both(alone, together, 12)
        mask = np.array([True, k == 1, False])
        options = {"reset_mask": mask, "scenario": scenario, "duration": 0.08}
        one = alone.reset(seed=k, options=dict(options))
        same(one, together.reset(seed=k, options=dict(options)))
    assert drive_both(alone, together, 30) > 3
    options = {"scenario": "uneven-delay-fig5", "duration": 0.08}  # of all rows
    same(alone.reset(seed=9, options=dict(options)), together.reset(seed=9, options=options))
    assert drive_both(alone, together, 20) > 1


@pytest.mark.parametrize(
    "options",
    [{"reset_mask": [True, False]}, {"scenario": "moon"}, {"frction": 0.5}],
    ids=["a list as mask", "no such scenario", "no such option"],
)
def test_after_a_reset_that_is_refused_everything_is_as_it_was(options: Any) -> None:
    pairs = [EstimateObservation(gym.make_vec(VISION, 2), "exact-kf") for _ in range(2)]
    told = np.full((2, 1), 0.1, np.float32)
    for env in pairs:
        env.reset(seed=1)
        env.step(told)
    with pytest.raises((TypeError, ValueError)):
        pairs[0].reset(options=options)
    for step in range(5):
        ours, theirs = (env.step(told * step)[0] for env in pairs)
        assert ours.tobytes() == theirs.tobytes()
    mask = {"reset_mask": np.array([True, False])}
    one, other = (env.reset(seed=3, options=dict(mask))[0] for env in pairs)
    assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize("mode", MODES)
def test_nees_is_told_where_the_truth_is(mode: str) -> None:
    """With infos at the ends only, that is where a row's episode ended."""
    every, ends = (
        EstimateObservation(
            gym.make_vec(VISION, num_envs=3, autoreset_mode=mode, info=info, on_bad_action="fail"),
            "multirate-kf",
        )
        for info in ("all", "ends")
    )
    every.reset(seed=0)
    assert "nees" not in ends.reset(seed=0)[1]
    for step in range(20):
        told = np.zeros((3, 1), np.float32)
        if step % 5 == 4:
            told[step % 3] = BAD
        one, other = every.step(told), ends.step(told)
        same((*one[:4], {}), (*other[:4], {}))
        assert other[4]["beta_hat"].tobytes() == one[4]["beta_hat"].tobytes()
        ended = one[2] | one[3]
        if mode == "SameStep":
            one, other = ({**each[4].get("final_info", {})} for each in (one, other))  # type: ignore[assignment]
            same((0.0, one), (0.0, other))
        elif ended.any():
            assert other[4]["_nees"].tolist() == ended.tolist()
            assert other[4]["nees"][ended].tobytes() == one[4]["nees"][ended].tobytes()
            assert not other[4]["nees"][~ended].any()
        else:
            assert "nees" not in other[4]
