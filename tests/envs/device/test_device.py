"""The gradient engine takes the steps of the compiled one: equations, noise and sensors."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs import SCENARIOS

from ..helpers import FULL, IDS, unwrapped

torch = pytest.importorskip("torch")

from sideslip.envs.device import make_device_env  # noqa: E402
from sideslip.envs.engine.layout import Z  # noqa: E402
from sideslip.envs.numerics import functions as noise  # noqa: E402
from sideslip.envs.numerics.torch_backend import to_torch  # noqa: E402
from sideslip.envs.record import FAST  # noqa: E402
from sideslip.envs.vehicle.dynamics import Motion  # noqa: E402

from ..batches import MODES, batch  # noqa: E402
from .moments import (  # noqa: E402
    DRIVEN,
    EXACT,
    FUSION,
    UNEVEN,
    agrees,
    device_step,
    drive,
    episodes,
    largest_error,
)

DEVICES = ["cpu"] + ["cuda"] * torch.cuda.is_available()


@pytest.mark.plain
@pytest.mark.parametrize("device", DEVICES)
def test_the_noise_has_the_same_words_and_the_same_numbers_to_rounding(device: str) -> None:
    rng = np.random.default_rng(3)
    keys, ticks = rng.integers(0, 2**32, (2, 500)), rng.integers(0, 10**7, 500)
    told = [torch.as_tensor(each, device=device) for each in (*keys, ticks)]
    double = to_torch(torch.float64, noise._philox, noise.draw_normals)
    exact, normals = double._philox, double.draw_normals
    rough = to_torch(torch.float32, noise.draw_normals).draw_normals
    words = torch.stack(exact(*told, 5)).cpu().numpy()
    found = torch.stack(normals(*told, 5)).cpu().numpy()
    single = torch.stack(rough(*told, 5)).cpu().numpy()
    for i, (low, high, tick) in enumerate(zip(*keys.tolist(), ticks.tolist(), strict=True)):
        assert tuple(words[:, i].tolist()) == noise._philox(low, high, tick, 5)
        wanted = noise.draw_normals(low, high, tick, 5)
        assert np.abs(found[:, i] - wanted).max() < 1e-13
        assert np.abs(single[:, i] - wanted).max() < 2e-5


@pytest.mark.plain
def test_the_largest_word_has_a_normal_number_in_float32() -> None:
    """Its logarithm is rounded to above zero there."""
    pair = to_torch(torch.float32, noise._draw_normal_pair)._draw_normal_pair
    words = torch.full((4,), 2**32 - 1), torch.arange(4) << 30
    assert torch.isfinite(torch.stack(pair(*words))).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", IDS)
def test_a_step_from_the_same_state_is_the_same_on_every_id(name: str, device: str) -> None:
    scenario = {"base": "random-steering", "duration": 3.0}
    moments = episodes(name, 310, 3, scenario=scenario)
    assert moments.truncated.sum() == 3
    agrees(name, moments, scenario=scenario, device=device)


OFTEN = (  # a driver, a gust, an outage, tyres that change, two frictions, two of the papers'
    "double-lane-change", "gust", "sensor-outage", "stiffness-step", "split-friction",
    "tie-vision-fig7", "dakf-fig9",
)  # fmt: skip
RARELY = [pytest.param(each, marks=pytest.mark.long) for each in SCENARIOS if each not in OFTEN]


@pytest.mark.parametrize("scenario", [*OFTEN, *RARELY])
def test_so_it_is_in_every_scenario(scenario: str) -> None:
    steps = int(min(SCENARIOS[scenario].duration, 10.0) / 0.01) + 1
    agrees(FUSION, episodes(FUSION, steps, 7, scenario=scenario), scenario=scenario)


ARGUMENTS: list[dict[str, Any]] = [
    {"control_period": 1},
    {"control_period": 33, "scenario": "slalom"},
    {"control_period": 110, "camera": {"jitter": 0.1}},
    {"control_period": 90, "gps": {"period": 0.05, "delays": (0.2, 0.1)}},
    {"fast": "all", "control_period": 7},
    {"reference": "limited", "vehicle": "passenger-car", "nominal": "coms"},
    {"vehicle": {"base": "coms", "steering_lag": 0.0}},
    {"camera": {"phase": None, "loss": 0.3, "duplicate": 0.3, "jitter": 0.05}},
    {"gps": {"phase": None}},
    {"scenario": {"base": "random-steering", "camera_heading": 0.03, "camera_loss": 0.2}},
    {"scenario": {"base": "sine-with-dwell", "tyres": "dugoff"}},
    {"scenario": {"base": "sine-with-dwell", "tyres": "magic-formula"},
     "vehicle": {"base": "coms", "relaxation": 0.3}},
    {"gps": {"period": 0.1, "delays": (0.2, 0.05, 0.15, 0.1), "duplicate": 1.0}},
    {"yaw_first": False, "steering": True, "on_bad_action": "fail"},
    {"scenario": "coms-brake-in-turn", "reference": "lagged", "with_map": True},
    {"scenario": {"base": "recovery", "gps_period": 0.05}, "reference": "lagged"},
    {"scenario": "coms-slalom", "world": "v1", "with_map": True, "steering": True},
    {"scenario": "coms-double-lane-change", "world": "v1", "lead_in": 0.1, "control_period": 7},
]  # fmt: skip


@pytest.mark.parametrize("arguments", ARGUMENTS, ids=str)
def test_so_it_is_with_other_arguments(arguments: dict[str, Any]) -> None:
    steps = 4000 // arguments.get("control_period", 10)
    moments = episodes(FUSION, min(steps, 400), 4, **arguments)
    assert moments.after["delivered"].max() > 0
    agrees(FUSION, moments, **arguments)


FAILING: list[tuple[dict[str, Any], dict[str, Any], int]] = [
    ({"fast": "all"}, {"state": [{"v_y": v_y} for v_y in (3.0, -4.0, 8.0)], "friction": 0.2}, 1),
    ({"scenario": {"base": "gust", "half_width": 0.01}}, {}, 2),
    # a car of a gram that rolls backwards on linear tyres: the numbers overflow in nine ticks
    ({"vehicle": {"base": "coms", "mass": 1e-3, "yaw_inertia": 1e-3}, "strict": False,
      "scenario": FULL | {"tyres": "linear", "small_angle": True, "half_width": 1e300}},
     {"state": {"v_x": -5.0, "gamma": 0.1}}, 3),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "options", "code"), FAILING, ids=str)
def test_a_row_that_fails_stops_at_that_tick(
    arguments: dict[str, Any], options: dict[str, Any], code: int
) -> None:
    """Within a step, beside rows that go on; the rest of its episode is charged."""
    told = {"control_period": 50} | arguments
    moments = drive(batch(FUSION, 3, **told), 200, options=options)
    failed = moments.after["states"][moments.terminated]
    assert code in failed[:, Z.clock.failure]
    env = agrees(FUSION, moments, **told)
    assert (env.ticks_done < 50).any()


@pytest.mark.plain
def test_a_batch_has_the_episodes_of_its_seeds() -> None:
    """Row i of reset(seed=s) is the single environment of s + i."""
    env = make_device_env(UNEVEN, 4, camera={"phase": None})
    obs, infos = env.reset(seed=11)
    for i in range(4):
        alone = unwrapped(UNEVEN, camera={"phase": None})
        wanted, info = alone.reset(seed=11 + i)
        np.testing.assert_array_equal(obs[i], wanted)
        assert {name: each[i].item() for name, each in infos.items()} == info
        np.testing.assert_array_equal(env.motion[i], alone.motion)


@pytest.mark.parametrize("mode", [MODES[0], pytest.param(MODES[1], marks=pytest.mark.plain)])
def test_episodes_follow_each_other_as_in_the_vector_env(mode: str) -> None:
    """Resets of their own and by a mask, drives and ends: to 1e-9 over a few episodes."""
    told: dict[str, Any] = {
        "scenario": {"base": "random-steering", "duration": 0.07},
        "autoreset_mode": mode,
        "steering": True,
    }
    one: Any = batch(FUSION, 5, **told)
    other: Any = make_device_env(FUSION, 5, **told)
    one.reset(seed=[3, 1, None, 2**40, 9])
    one.np_random[2].bit_generator.state = np.random.default_rng(0).bit_generator.state
    other.set_state(one.get_state())
    for step in range(20):
        if step == 12:
            options = {"reset_mask": np.arange(5) < 2, "duration": [0.02, 0.03, 1.0, 1.0, 1.0]}
            one.reset(seed=4, options=dict(options))
            other.reset(seed=4, options=options | {"reset_mask": torch.arange(5) < 2})
        actions = np.random.default_rng(step).uniform(-1.0, 1.0, (5, 2)).astype(np.float32)
        *wanted, infos = one.step(actions)
        *found, device_infos = other.step(torch.as_tensor(actions))
        for a, b in zip(wanted, found, strict=True):
            np.testing.assert_allclose(np.asarray(a), b, rtol=0.0, atol=1e-6)
        if "final_obs" in infos:
            over = infos["_final_obs"]
            assert device_infos["_final_obs"].tolist() == over.tolist()
            final = np.stack(infos["final_obs"][over])
            np.testing.assert_allclose(final, device_infos["final_obs"][over], atol=1e-6)
            t = infos["final_info"]["t"][over]
            np.testing.assert_allclose(t, device_infos["final_info"]["t"][over])
        assert largest_error(one.get_state(), other.get_state()) < EXACT
    assert [each.bit_generator.state for each in one.np_random] == [
        each.bit_generator.state for each in other.np_random
    ]


@pytest.mark.long
@pytest.mark.parametrize("name", DRIVEN)
def test_stable_driving_is_the_same(name: str) -> None:
    one, other = batch(name, 8), make_device_env(name, 8)
    one.reset(seed=2)
    other.reset(seed=2)
    for step in range(40):
        actions = np.random.default_rng(step).uniform(-1.0, 1.0, one.action_space.shape or ())
        one.step(actions.astype(np.float32))
        other.step(torch.as_tensor(actions))
    assert largest_error(one.get_state(), other.get_state()) < EXACT


# What float32 costs a step of 10 ms, and a second: at 30 m from the start, with 100 N m motors.
ROUGH = {"v_x": 1e-5, "v_y": 1e-6, "gamma": 1e-6, "psi": 2e-6, "X": 1e-4, "Y": 2e-5}
SECOND = {"v_x": 1e-4, "v_y": 2e-5, "gamma": 2e-5, "psi": 2e-5, "X": 5e-4, "Y": 1e-4}


@pytest.mark.parametrize("scenario", ["random-steering", "double-lane-change", "gust"])
def test_float32_costs_little(scenario: str) -> None:
    moments = episodes(FUSION, 600, 7, scenario=scenario)
    told: dict[str, Any] = {"scenario": scenario, "dtype": "float32"}
    (_, rewards, terminated, _, _), env = device_step(FUSION, moments, **told)
    assert terminated.tolist() == moments.terminated.tolist()
    after = env.get_state()
    for name, limit in ROUGH.items():
        column = Motion._fields.index(name)
        error = np.abs(after["states"][:, column] - moments.after["states"][:, column])
        assert 0.0 < error.max() < limit, name
    assert np.abs(rewards.numpy() - moments.rewards).max() < 1e-6
    fast = np.abs(after["rows"] - moments.after["rows"]).max((0, 1))
    assert fast[FAST.gyro] < 1e-6
    assert fast[FAST.accel_x] < 1e-3
    assert np.array_equal(after["delivered"], moments.after["delivered"])


@pytest.mark.long
def test_float32_costs_little_in_a_second() -> None:
    one = make_device_env(FUSION, 32)
    other = make_device_env(FUSION, 32, dtype=torch.float32)
    for env in (one, other):
        env.reset(seed=2)
        for step in range(100):
            env.step(np.random.default_rng(step).uniform(-1.0, 1.0, (32, 1)))
    error = (one.motion - other.motion).abs().amax(0)
    for name, limit in SECOND.items():
        assert 0.0 < error[Motion._fields.index(name)] < limit, name


@pytest.mark.plain
def test_whoever_has_a_result_may_write_into_it() -> None:
    env = make_device_env(FUSION, 2)
    idle = np.zeros((2, 1))
    for first in (True, False):
        obs, infos = env.reset(seed=0) if first else env.step(idle)[::4]
        kept = obs.clone(), infos["t"].clone()
        obs.fill_(7.0)
        infos["t"].fill_(7.0)
        obs, infos = env.reset(options={"reset_mask": np.array([True, False])})
        assert torch.equal(obs[1], kept[0][1]) and infos["t"][1] == kept[1][1]


@pytest.mark.plain
def test_a_snapshot_goes_on_in_the_compiled_engine() -> None:
    """There and back: what a device leaves out of a state nobody needs."""
    env = make_device_env(FUSION, 3, camera={"duplicate": 0.5})
    env.reset(seed=0)
    host = batch(FUSION, 3, camera={"duplicate": 0.5})
    for step in range(6):
        snapshot = env.get_state()
        host.set_state(snapshot)
        action = np.full((3, 1), 0.1 * step, np.float32)
        host.step(action)
        env.step(torch.as_tensor(action))
        assert largest_error(host.get_state(), env.get_state()) < EXACT
    env.set_state(snapshot)
    env.step(torch.as_tensor(action))
    assert largest_error(host.get_state(), env.get_state()) < EXACT


@pytest.mark.long
def test_compiled_ticks_are_the_same_and_compiled_once() -> None:
    scenario = {"base": "random-steering", "duration": 0.3}
    moments = episodes(FUSION, 40, scenario=scenario)
    env = agrees(FUSION, moments, scenario=scenario, compile=True)
    with torch.compiler.set_stance("fail_on_recompile"):
        for _ in range(3):
            env.step(torch.zeros(env.num_envs, 1))


@pytest.mark.long
def test_more_environments_are_compiled_than_torch_allows_for_one_text(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By dynamo alone: what refuses a ninth, here a third, comes before any machine code."""
    monkeypatch.setattr("torch._dynamo.config.recompile_limit", 2)
    whole = torch.compile

    def trace(f: Any, fullgraph: bool, options: Any) -> Any:
        return whole(f, fullgraph=fullgraph, backend="eager")

    monkeypatch.setattr(torch, "compile", trace)
    for period in range(1, 4):
        env = make_device_env(UNEVEN, 2, control_period=period, compile=True)
        env.reset(seed=0)
        assert env.step(torch.zeros(2, 1))[0].shape == (2, len(env.layout))
