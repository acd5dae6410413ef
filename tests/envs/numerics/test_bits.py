"""Compiled code, plain Python and NumPy arrays give the same bits: no tolerance anywhere."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sideslip.envs import COMS, PASSENGER_CAR, stability
from sideslip.envs.engine import reset as restart
from sideslip.envs.engine import step as kernel
from sideslip.envs.engine.config import make_car
from sideslip.envs.numerics import functions
from sideslip.envs.numerics import functions as noise
from sideslip.envs.numerics.functions import FOREVER
from sideslip.envs.numerics.jit import as_python
from sideslip.envs.numerics.primitives import ARRAYS
from sideslip.envs.scenarios import driver as programme
from sideslip.envs.scenarios.driver import DriverParams, compute_driver_angle
from sideslip.envs.scenarios.road import make_path, transform_path
from sideslip.envs.task import make_reference_params
from sideslip.envs.vehicle import dynamics, tyres
from sideslip.envs.vehicle.dynamics import DisturbanceForces, Motion, RoadParams
from sideslip.envs.vehicle.tyres import TYRE_LAWS, PlantVariant, TyreInputs

from ..helpers import FULL, IDS, LINEAR, bits, play, unwrapped

pytestmark = pytest.mark.plain

RNG = np.random.default_rng(7)
N = 20
CARS = {"coms": make_car(COMS.replace(relaxation=0.0)), "passenger-car": make_car(PASSENGER_CAR)}
ROAD, PUSH = RoadParams(0.01, -5.0, 20.0, 0.5, -0.3), DisturbanceForces(50.0, -20.0, 30.0)
LAWS = range(len(TYRE_LAWS))
PLANTS = [(a, law, roll) for a in (0, 1) for law in LAWS for roll in (0, 1)]
SPREAD = np.array([9.0, 2.0, 1.0, 2.0, 50.0, 50.0, 20.0, 3.0, 2.0, 0.3, 1.0, 0.1, 0.1])


def motions() -> list[Motion]:
    """Forwards, backwards, near standstill and at standstill."""
    rows = RNG.normal(size=(N, len(Motion._fields))) * SPREAD
    rows[::5, :3] *= 0.01
    rows[0] = 0.0
    return [Motion(*row) for row in rows.tolist()]


def inputs() -> list[TyreInputs]:
    return [TyreInputs(*row) for row in (RNG.normal(size=(N, 3)) * (0.2, 200.0, 200.0)).tolist()]


def lanes(values: list[Any]) -> Any:
    """The same numbers or tuples with an array of all values in each place."""
    if isinstance(values[0], tuple):
        return type(values[0])(*np.array(values).T)
    return np.array(values)


def agree(function: Any, lists: list[list[Any]], call: Callable[..., Any]) -> list[Any]:
    """Assert that the three backends' bits are equal; returns the compiled values."""
    compiled = [call(function, *each) for each in zip(*lists, strict=True)]
    python = [call(as_python(function), *each) for each in zip(*lists, strict=True)]
    assert bits(python) == bits(compiled)
    arrays = call(as_python(function, ARRAYS), *map(lanes, lists))
    if isinstance(arrays, tuple):
        arrays = np.array([np.broadcast_to(column, len(compiled)) for column in arrays]).T
    assert bits(arrays) == bits(np.array(compiled))
    return compiled


@pytest.mark.parametrize("car", CARS)
@pytest.mark.parametrize(("small_angle", "law", "roll"), PLANTS)
def test_plant(car: str, small_angle: int, law: int, roll: int) -> None:
    variant = PlantVariant(small_angle, law, roll)

    def load_of(function: Any, inputs: Any) -> Any:
        return function(inputs, CARS[car], variant)

    def derivative(function: Any, motion: Any, load: Any) -> Any:
        return function(motion, load, PUSH, CARS[car], ROAD, variant)

    def step(function: Any, motion: Any, a: Any, b: Any, c: Any) -> Any:
        return function(motion, (a, b, c), PUSH, CARS[car], ROAD, 1e-3, variant)

    state = motions()
    load = agree(tyres.compute_tyre_load, [inputs()], load_of)
    agree(dynamics.derivative, [state, load], derivative)
    loads = [load, load[1:] + load[:1], load[2:] + load[:2]]
    for rule in (dynamics.kutta3, dynamics.rk4):
        agree(rule, [state, *loads], step)


def test_driver() -> None:
    track = transform_path(make_path("iso-3888-2", 1.095), 3.0, 0.5, 1.0)
    road, target = RoadParams(0.02, 0.0, 40.0), make_reference_params(COMS)
    world = track, road, target, DriverParams(1.0, 1.0, 0.99, 1.0), 0.6
    agree(compute_driver_angle, [motions()], lambda f, motion: f(0.01, motion, *world))


@pytest.mark.parametrize("small_angle", [0, 1])
def test_sideslip_angle(small_angle: int) -> None:
    speeds = [list(column) for column in zip(*[m[:2] for m in motions()], strict=True)]
    agree(dynamics.compute_sideslip_angle, speeds, lambda f, v_x, v_y: f(v_x, v_y, small_angle))


def test_steering() -> None:
    numbers = RNG.uniform(0.01, 2.0, programme.STEERING_WIDTH)
    numbers[3 : 5 * programme.SINES : 5] = 100.0, 0.0, 300.0, 40.0
    numbers[4 : 5 * programme.SINES : 5] = 900.0, FOREVER, 1200.0, 50.0
    numbers[5 * programme.SINES + 2 :: 3] = 200.0
    ticks = [float(tick) for tick in range(0, 2000, 7)]
    agree(programme.compute_steering, [ticks], lambda f, tick: f(tick, numbers))


@pytest.mark.parametrize("name", ["draw_normals", "draw_uniforms"])
def test_noise(name: str) -> None:
    words = [[2**32 - 3] * N, [2**31 + 11] * N, list(range(N)), [3] * N]
    agree(getattr(noise, name), words, lambda f, *counter: f(*counter))


@pytest.mark.parametrize("name", ["_sin_kernel", "_cos_kernel", "sincos", "atan", "exp", "wrap"])
def test_elementary(name: str) -> None:
    x = (RNG.normal(size=300) * 10.0).tolist()
    agree(getattr(functions, name), [x], lambda f, value: f(value))


EPISODES: list[dict[str, Any]] = [
    {},
    {"scenario": "slalom", "fast": "all", "reference": "limited"},
    {"scenario": "dakf-fig6", "reference": "model"},
    {"scenario": "double-layer-fig9", "control_period": 33},
    {"scenario": {"base": "slalom", "bank": 0.1, "grade": -0.05, "curve_start": -50.0}},
    {"scenario": "tie-vision-fig9", "vehicle": {"base": "coms", "antenna_ahead": 0.4}},
    {"scenario": LINEAR | {"curvature": 0.02, "curve_start": 0.0, "curve_ramp": 1.0}},
    {"scenario": FULL | {"acceleration": 1.0, "speed": 0.0}, "control_period": 33},
    {"vehicle": {"base": "passenger-car", "motor_lag": 0.0}, "scenario": "step-steer"},
]
_PROGRAMMES: list[dict[str, Any]] = [
    {"base": "double-lane-change", "onset": 0.05},
    {"base": "curved-road-driver", "curve_start": -5.0, "speed_change": -1.0},
    {"base": "stiffness-step", "tyre_change_time": (0.1, 0.3)},
    {"base": "split-friction", "change_start": 0.1},
    {"base": "sine-with-dwell", "onset": 0.0, "frequency": 4.0, "hold": 0.1},
    {"base": "sine", "steering": "sweep", "onset": 0.1, "hold": 0.2, "frequency_2": 3.0},
    {"base": "sine", "steering": "ramp", "onset": 0.1, "hold": 0.2},
]
EPISODES += [
    dict[str, Any](scenario=each, reference="model", steering=True) for each in _PROGRAMMES
]


@pytest.mark.compiled
@pytest.mark.parametrize(("arguments", "name"), [*zip(EPISODES, IDS * 4, strict=False)], ids=str)
def test_whole_steps(arguments: dict[str, Any], name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def episode() -> Any:
        env = unwrapped(name, **arguments)
        start = env.reset(seed=11)
        first = env.record
        rng = np.random.default_rng(3)
        shape = 400 // env.control_period, *(env.action_space.shape or ())
        moments = play(env, rng.uniform(-1.2, 1.2, shape))
        assert sum(len(moment.record.packets) for moment in moments) > 0
        return bits((start, first, moments, env.get_state()["state"], env.get_state()["params"]))

    compiled = episode()
    monkeypatch.setattr(stability, "reset_vehicle", as_python(restart.reset_vehicle))
    step = as_python(kernel.step_episode)
    monkeypatch.setattr(stability, "_compile_step", lambda: step)
    assert episode() == compiled
