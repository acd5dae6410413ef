"""Users' own estimators around a vector env, one a row; snapshots of wrapped vector envs."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs import COMS
from sideslip.estimators import make_estimator
from sideslip.estimators.vector.estimate import EstimateObservation, TruthObservation
from tests.envs import batches
from tests.envs.batches import actions, same
from tests.estimators.vector.fleets import BAD, MODES, VISION, drive_both, native, pair
from tests.estimators.wrappers.constant import Constant

UKF = "tests.estimators.wrappers.ukf:Ukf"
PHASE: dict[str, Any] = {"camera": {"phase": None}}


def ours(**arguments: Any) -> Any:
    return make_estimator("exact-kf", q_beta=1e-3, **arguments)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", ["sync", "native"])
def test_every_row_is_the_environment_wrapped_alone(kind: str, mode: str) -> None:
    """FilterPy's UKF: a fresh one where a row starts anew, with the clock drawn there."""
    pytest.importorskip("filterpy")
    if kind == "sync":
        layer: dict[str, Any] = {"estimator": UKF, "outputs": ["beta", "y_l"]}
        alone, together = pair(VISION, 2, mode, [layer], **PHASE)
    else:
        envs = batches.pair(VISION, 2, mode, **PHASE)
        alone, together = (EstimateObservation(each, UKF, vehicle="truth") for each in envs)
    assert drive_both(alone, together, 12, seed=[11, 5]) > (kind == "sync")


@pytest.mark.parametrize("mode", MODES)
def test_a_factory_of_ours_is_compiled_and_has_the_bits_of_the_name(mode: str) -> None:
    options = {"q_beta": 1e-3}
    by_name = EstimateObservation(native(mode), "exact-kf", options=options)
    by_factory = EstimateObservation(native(mode), ours)
    assert type(by_factory.estimator) is type(by_name.estimator)
    assert drive_both(by_name, by_factory, 20, seed=1) > 1


@pytest.mark.parametrize("mode", MODES)
def test_a_row_is_built_anew_only_where_its_car_changes(mode: str) -> None:
    """And only rows that start an episode forget; the others go on."""
    built = []

    def factory(**arguments: Any) -> Constant:
        built.append(Constant(**arguments))
        return built[-1]

    env = EstimateObservation(native(mode, **PHASE), factory)
    env.reset(seed=0)
    assert len(built) == 3
    bad = np.array([[0.0], [BAD], [0.0]], np.float32)
    env.step(bad)
    lengths = [len(own.calls) for own in built]
    env.step(0.0 * np.nan_to_num(bad))
    fresh = 1 if mode == "NextStep" else 2
    assert [len(own.calls) for own in built] == [lengths[0] + 1, 1 + fresh, lengths[2] + 1]
    scenarios = ["tie-vision-fig7", batches.SHORT, batches.SHORT]
    env.reset(options={"scenario": scenarios})
    assert len(built) == 4 and built[3].arguments["speed"] == pytest.approx(25.0 / 3.6)
    batch: Any = env.estimator
    assert [each.inner for each in batch] == [built[3], built[1], built[2]]
    phases = [own.calls[0][1]["camera"].phase for own in (built[3], built[1], built[2])]
    assert phases == [each["camera"].phase for each in env.unwrapped.slow_sensors]  # type: ignore[attr-defined]


def test_a_nan_of_one_row_ends_its_episode_alone() -> None:
    env = EstimateObservation(native("NextStep"), Constant, std=False)
    env.reset(seed=0)
    batch: Any = env.estimator
    batch[1].inner.value = (0.8, 0.2, np.nan)
    obs = env.step(np.zeros((3, 1), np.float32))[0]
    assert np.isnan(obs).any(axis=1).tolist() == [False, True, False]
    _, _, terminated, _, _ = env.step(obs[:, -2:-1])
    assert terminated.tolist() == [False, True, False]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("layer", ["exact-kf", "multirate-kf", "truth", Constant, UKF])
def test_a_snapshot_of_a_wrapped_vector_env_continues_bit_for_bit(layer: Any, mode: str) -> None:
    """Over ends of episodes, and back from another scenario and a finished step."""
    if layer == UKF:
        pytest.importorskip("filterpy")
    if layer == "truth":
        inner = EstimateObservation(native(mode), "exact-kf", vehicle="truth")
        env: Any = TruthObservation(inner, ["mass", "friction"])
    else:
        env = EstimateObservation(native(mode, **PHASE), layer)
    env.reset(seed=2)
    for i in range(7):  # the last action ends a row
        env.step(actions(env, i))
    snapshot = env.get_state()
    steps = 10 if layer == UKF else 30
    once = [env.step(actions(env, step)) for step in range(7, 7 + steps)]
    changes = {"scenario": "uneven-delay-fig5", "vehicle": COMS.scale_stiffness(0.9)}
    env.reset(seed=8, options=changes)
    env.step(actions(env, 1))
    for _ in range(2):
        env.set_state(snapshot)
        for i, before in enumerate(once, start=7):
            same(env.step(actions(env, i)), before)


def test_a_snapshot_brings_back_the_rows_that_a_mask_leaves_alone() -> None:
    env: Any = EstimateObservation(native("NextStep"), "exact-kf")
    env.reset(seed=2)
    obs = env.step(actions(env, 0))[0]
    snapshot = env.get_state()
    env.step(actions(env, 1))
    env.set_state(snapshot)
    mask = np.array([True, False, False])
    again, _ = env.reset(seed=5, options={"reset_mask": mask})
    assert again[1:].tobytes() == obs[1:].tobytes() and again[0].tobytes() != obs[0].tobytes()
