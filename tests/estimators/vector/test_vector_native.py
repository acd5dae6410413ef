"""EstimateObservation around the vector env: the bits of the one around single environments."""

import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.estimators import FILTERS
from sideslip.estimators.vector.estimate import EstimateObservation, TruthObservation
from tests.envs.batches import MODES, pair
from tests.envs.helpers import IDS
from tests.estimators.vector.fleets import BAD, VISION, drive_both, home, outputs, same_bits

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")


def wrapped(env_id: str, count: int, mode: str, layer: dict[str, Any], **kwargs: Any) -> Any:
    """Around SyncVectorEnv, and around the vector env."""
    return [EstimateObservation(env, **layer) for env in pair(env_id, count, mode, **kwargs)]


QUICK = ("exact-kf", "course-kf")
KINDS = [pytest.param(name, marks=() if name in QUICK else (pytest.mark.long,)) for name in FILTERS]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", KINDS)
def test_every_filter_says_the_same(name: Any, mode: str) -> None:
    env_id, sensor = home(name)
    layer = {"estimator": name, "outputs": outputs(name)}
    clocks: dict[str, Any] = {sensor: {"phase": None, "loss": 0.2}}
    alone, together = wrapped(env_id, 3, mode, layer, **clocks)
    assert together.layout == alone.layout
    assert drive_both(alone, together, 60, seed=[11, 5, 7]) > 6


@pytest.mark.long
@pytest.mark.parametrize(("env_id", "mode"), [*zip(IDS, itertools.cycle(MODES), strict=False)])
def test_so_it_does_over_many_episodes(env_id: str, mode: str) -> None:
    name = "course-kf" if env_id == "sideslip/YawGps-v0" else "multirate-kf"
    alone, together = wrapped(env_id, 5, mode, {"estimator": name})
    assert drive_both(alone, together, 5_000, seed=1) > 50


@pytest.mark.parametrize("mode", MODES)
def test_masks_and_other_scenarios_tell_the_filters(mode: str) -> None:
    alone, together = wrapped(VISION, 3, mode, {"estimator": "multirate-kf"})
    same_bits(alone.reset(seed=1), together.reset(seed=1))
    for k, scenario in enumerate(("uneven-delay-fig5", "tie-vision-fig7", "sine")):
        drive_both(alone, together, 12)
        mask = np.array([True, k == 1, False])
        options = {"reset_mask": mask, "scenario": scenario, "duration": 0.08}
        one = alone.reset(seed=k, options=dict(options))
        same_bits(one, together.reset(seed=k, options=dict(options)))
    assert drive_both(alone, together, 30) > 3


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
        same_bits((*one[:4], {}), (*other[:4], {}))
        assert other[4]["beta_hat"].tobytes() == one[4]["beta_hat"].tobytes()
        ended = one[2] | one[3]
        if mode == "SameStep":
            one, other = ({**each[4].get("final_info", {})} for each in (one, other))  # type: ignore[assignment]
            same_bits((0.0, one), (0.0, other))
        elif ended.any():
            assert other[4]["_nees"].tolist() == ended.tolist()
            assert other[4]["nees"][ended].tobytes() == one[4]["nees"][ended].tobytes()
            assert not other[4]["nees"][~ended].any()
        else:
            assert "nees" not in other[4]


def test_the_spec_tells_of_the_truth_too() -> None:
    told: dict[str, Any] = {"autoreset_mode": "SameStep", "on_bad_action": "fail"}
    env = gym.make_vec(VISION, num_envs=2, **told)
    together = TruthObservation(EstimateObservation(env, "multirate-kf"), ["mass", "friction"])
    assert together.spec is not None
    again = gym.make_vec(gym.envs.registration.EnvSpec.from_json(together.spec.to_json()))
    assert again.single_observation_space == together.single_observation_space
    assert again.metadata["autoreset_mode"] == env.metadata["autoreset_mode"]
    assert drive_both(again, together, 8, seed=4) == 1
    env.spec = None
    assert together.spec is None
