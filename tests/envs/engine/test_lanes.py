"""Lanes: cars computed abreast have the bits of the car alone, whoever their neighbours are."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sideslip.envs.engine.layout import FLAGS
from sideslip.envs.numerics import functions as noise
from sideslip.envs.numerics.functions import (
    atan,
    atan2,
    compute_arctan_gap,
    compute_sine,
    draw_normals,
    draw_uniforms,
    exp,
    sincos,
    smoothstep,
    wrap,
)
from sideslip.envs.numerics.jit import jit
from sideslip.envs.numerics.packed import load_element, write
from sideslip.envs.numerics.primitives import (
    absolute,
    any_lane,
    floor,
    frexp,
    maximum,
    minimum,
    select,
    sqrt,
    to_float,
    to_int,
)
from sideslip.envs.numerics.simd import LANES
from sideslip.envs.vehicle.dynamics import Motion

from ..batches import SHORT, batch, drive, pair, same, same_cars
from ..helpers import bits

FUSION = "sideslip/YawFusion-v0"


@jit
def _operators(x: Any, y: Any) -> Any:
    i, j = to_int(floor(x)), to_int(floor(y))
    both = (x < y) & (x != 2.0) | (y >= 1.0)
    words = (((i * 3) & 255) << 2) ^ (j >> 1) | (i - j)
    return (
        x + y * 2.0 - 1.0 / y,
        select(both, x, y),
        select((x == y) | (x <= 0.0) & (y > -1.0), 1.0, 0.0 - x),
        to_float(words),
    )


@jit
def _primitives(x: Any, y: Any) -> Any:
    m, e = frexp(absolute(y) + 1e-300)
    return minimum(x, y), maximum(x, 0.5), absolute(y), floor(x), sqrt(absolute(x)), m, e


@jit
def _random(x: Any, y: Any) -> Any:
    return draw_normals(to_int(x * x), 77, to_int(floor(y * y)), 3)


@jit
def _uniform(x: Any, y: Any) -> Any:
    return draw_uniforms(5, to_int(x * x), to_int(floor(y * y)), noise.CHANNELS.gps_link, 2)


@jit
def _turned(x: Any, y: Any) -> Any:
    s, c = sincos(x)
    near = compute_arctan_gap(x), compute_sine(y)
    return s, c, atan(x), atan2(y, x), exp(minimum(absolute(x), 7.0)), wrap(x), *near


@jit
def _stepped(x: Any, y: Any) -> Any:
    shape = 0.0
    if any_lane(x > 0.0):  # a variable that is a number on one way and lanes on the other
        shape = shape + smoothstep(x)
    return shape, y


FUNCTIONS = [_operators, _primitives, _random, _uniform, _turned, _stepped]
_STRANGE = [0.0, -0.0, 1e-310, 1e300, -1e300, np.inf, -np.inf, np.nan, 2.0, 0.5, -3.0]


def _alone(function: Callable[..., Any], x: float, y: float) -> list[float]:
    return [float(value) for value in function(x, y)]


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda each: each.__name__)
def test_lanes_hold_the_bits_of_single_numbers(function: Callable[..., Any]) -> None:
    rng = np.random.default_rng(5)
    x, y = rng.normal(size=(2, 20 * LANES)) * np.exp(rng.normal(size=(2, 20 * LANES)))
    if function is _primitives:  # nothing here asks for an integer of them
        x[: len(_STRANGE)], y[LANES : LANES + len(_STRANGE)] = _STRANGE, _STRANGE
    if function is _stepped:
        y[: len(x) // 2] = -1.0
    width = len(function(0.3, 0.7))
    where = tuple(range(width))

    @jit
    def abreast(x: Any, y: Any, out: Any) -> None:
        write(out, function(load_element(x, 0), load_element(y, 0)), where)

    out = np.empty((width, LANES))
    for start in range(0, len(x), LANES):
        here = slice(start, start + LANES)
        abreast(x[None, here].copy(), y[None, here].copy(), out)
        alone = [_alone(function, *each) for each in zip(x[here].tolist(), y[here], strict=True)]
        assert np.array_equal(out.T, np.array(alone), equal_nan=True)
        numbers = ~np.isnan(alone)
        assert np.array_equal(np.signbit(out.T)[numbers], np.signbit(alone)[numbers])


@pytest.mark.parametrize("count", [1, 2, 3, LANES - 1, LANES, 2 * LANES + 5])
def test_any_number_of_rows(count: int) -> None:
    alone, together = pair(FUSION, count)
    same(alone.reset(seed=3), together.reset(seed=3))
    drive(alone, together, 60)


def test_rows_are_computed_abreast() -> None:
    """The others of these tests would pass without any lanes."""
    env = batch(FUSION, 2 * LANES)
    env.reset(seed=0)
    assert not env.engine.lane_buffers.block.rows.any()
    obs = env.step(np.zeros((2 * LANES, 1)))[0]
    assert sorted(env.engine.lane_buffers.members) == list(range(LANES, 2 * LANES))
    assert bits(env.engine.lane_buffers.block.rows[:, 0, :].T) == bits(env.rows[LANES:, :, 0])
    assert obs[LANES:, 0].tolist() == env.rows[LANES:, -1, 0].astype(np.float32).tolist()


def test_tyres_that_relax() -> None:
    """Whole lanes of them, as no kind below has."""
    tyres = {"tyres": "magic-formula", "vehicle": {"relaxation": 0.3, "transfer_height": 0.4}}
    alone, together = pair(FUSION, LANES, scenario=SHORT | tyres)
    same(alone.reset(seed=3), together.reset(seed=3))
    drive(alone, together, 60)
    assert np.any(together.motion[:, Motion._fields.index("slip_f")] != 0.0)


KINDS: list[dict[str, Any]] = [
    {"base": "random-steering"},
    {"base": "double-lane-change", "lags": False},
    {"base": "curved-road-driver"},
    {"base": "stiffness-step", "tyre_change_time": 0.1},
    {"base": "split-friction", "roll": False},
    {"base": "gust", "tyres": "linear"},
    {"base": "step-steer", "small_angle": True, "tyres": "linear"},
    {"base": "random-steering", "bank": 0.05, "grade": -0.03},
    {"base": "random-steering", "tyres": "dugoff"},
    {"base": "random-steering", "tyres": "magic-formula"},
    {"base": "gust", "tyres": "magic-formula", "vehicle": {"relaxation": 0.3}},
    {"base": "coms-brake-in-turn", "change_start": 0.05},
    {"base": "recovery", "vehicle": {"motor_power": 500.0}},
]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_neighbours_of_other_kinds(mode: str) -> None:
    """Every row has another text than the next, and episodes end within steps, at several times."""
    count = 5 * len(KINDS) + 3
    ends = (0.2, 0.255, 0.301)
    scenarios = [KINDS[i % len(KINDS)] | {"duration": ends[i % 3]} for i in range(count)]
    alone, together = pair(FUSION, count, mode)
    for i, car in enumerate(alone.envs):  # sync hands one set of options to all
        car.reset(seed=i, options={"scenario": scenarios[i]})
    together.reset(seed=0, options={"scenario": scenarios})
    same_cars(alone, together)
    rng = np.random.default_rng(2)
    for _ in range(18):
        action = rng.uniform(-1.0, 1.0, (count, 1)).astype(np.float32)
        stepped = together.step(action)
        for i, car in enumerate(alone.envs):
            obs, reward, failed, ended, info = car.step(action[i])
            assert bits(obs) == bits(stepped[0][i]) and reward == stepped[1][i]
            assert (failed, ended) == (stepped[2][i], stepped[3][i])
            assert info["beta"] == stepped[4]["beta"][i]


def test_scenarios_of_one_kind_stand_next_to_each_other() -> None:
    count = 6 * LANES
    env = batch(FUSION, count)
    env.reset(seed=0, options={"scenario": ["gust", "curved-road-driver"] * (count // 2)})
    follows = env.engine.arrays.switches[env.engine.lane_buffers.order][:, FLAGS.steering]
    assert (np.diff(follows) != 0).sum() == 1  # all drivers together, all programmes together
    assert sorted(env.engine.lane_buffers.order) == list(range(count))
    snapshot, sorted_order = env.get_state(), env.engine.lane_buffers.order.copy()
    env.reset(seed=0)
    assert env.engine.lane_buffers.order.tolist() == list(range(count))
    env.set_state(snapshot)
    assert env.engine.lane_buffers.order.tolist() == sorted_order.tolist()


def test_a_block_with_a_car_that_fails_is_stepped_car_by_car() -> None:
    """A car near its end is one of a block; the others keep their bits."""
    alone, together = pair(FUSION, LANES, scenario=SHORT | {"duration": 2.0})
    same(alone.reset(seed=3), together.reset(seed=3))
    thrown = {"state": {"gamma": 6.0, "v_y": 3.0}}
    alone.envs[4].reset(seed=9, options=thrown)
    mask = np.arange(LANES) == 4
    together.reset(seed=9 - 4, options=thrown | {"reset_mask": mask})
    failed = False
    for _ in range(30):
        action = np.zeros((LANES, 1), np.float32)
        stepped = together.step(action)
        for i, car in enumerate(alone.envs):
            if failed and i == 4:
                continue
            obs, reward, over, _, _ = car.step(action[i])
            assert bits(obs) == bits(stepped[0][i]) and reward == stepped[1][i]
            if i == 4:
                failed = bool(over)
    assert failed
