"""CPU time of a tick of the plant alone: ours, and the same in C (`plant.c`, compiled on the spot).

A tick is a millisecond of one car of `YawFusion-v0`: actuators that lag, the loads at the tick's
middle and end, Fiala tyres, roll, and Kutta's three stages; no sensors, no driver.
"""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from ...envs.engine.layout import P, Z
from ...envs.numerics.functions import TICK
from ...envs.numerics.jit import jit
from ...envs.numerics.packed import make_offsets, read, write
from ...envs.numerics.simd import LANES
from ...envs.record import Array
from ...envs.vehicle.actuators import apply_lag
from ...envs.vehicle.dynamics import CarParams, DisturbanceForces, Motion, RoadParams, kutta3
from ...envs.vehicle.tyres import FIALA, PlantVariant, TyreInputs, compute_tyre_load
from .timing import AbsentError, Effort, TimeTable, Workload

_FLAGS = ("-O3", "-march=native", "-ffp-contract=off")
_VECTOR_FLAGS = """
-fopenmp-simd -fno-math-errno -fno-trapping-math -fno-signed-zeros -fschedule-insns -fsched-pressure
"""  # gcc makes vectors of square roots, floor and choices; no number changes
CARS, _TICKS = 1024, 10  # cars at once; ticks a call
PLANT, C = "plant", "plant in C"

_CAR, _ROAD = make_offsets(CarParams)[0], make_offsets(RoadParams)[0]
_MOTION, _PUSH = make_offsets(Motion)[0], make_offsets(DisturbanceForces)[0]
_INPUTS = make_offsets(TyreInputs)[0]


def _find_compiler() -> str:
    """Find the C compiler: that of the variable CC, or the first one on the path."""
    for name in (os.environ.get("CC", ""), "gcc", "clang", "cc"):
        if name and (path := shutil.which(name)):
            return path
    raise AbsentError("no C compiler")


def read_source() -> str:
    """Read the text of `plant.c`."""
    return files(__package__).joinpath("plant.c").read_text(encoding="utf-8")


def _load_c_plant() -> Any:
    """Compile and load the function `plant` of `plant.c`."""
    with TemporaryDirectory() as folder:
        library = Path(folder) / "plant.so"
        flags = [*_FLAGS, *_VECTOR_FLAGS.split(), f"-DBLOCK={LANES}", "-shared", "-fPIC"]
        command = [_find_compiler(), *flags, "-x", "c", "-", "-o", str(library)]
        run = subprocess.run(command, input=read_source(), capture_output=True, text=True)
        if run.returncode:
            last = (run.stderr.strip().splitlines() or ["it gave no reason"])[-1]
            raise AbsentError(f"{command[0]} does not compile it: {last}")
        function = ctypes.CDLL(str(library)).plant  # stays when the file is gone
    pointers = [ctypes.c_void_p] * 7
    function.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_double, *pointers]
    function.restype = None
    return function


class Cars(NamedTuple):
    """Cars at reset with random commands, arrays (blocks, fields, LANES) as the plant's tuples."""

    remaining: Array  # (4,): fraction of a deviation at middle and end: steering, then motors
    cars: Array
    roads: Array
    pushes: Array
    commands: Array
    motions: Array
    acting: Array

    def clone(self) -> "Cars":
        """Copy the cars, for another workload."""
        return Cars(*(array.copy() for array in self))


_Advance = Callable[[Cars, int], object]  # moves cars on by some ticks, in place


def _make_cars(count: int, seed: int = 0) -> Cars:
    """Make cars as the seeds of `YawFusion-v0` draw, all with car 0's lags; count: n LANES."""
    env: Any = gym.make_vec("sideslip/YawFusion-v0", num_envs=count)
    env.reset(seed=seed)
    (p, z, *_), rng = env.engine.arrays, np.random.default_rng(seed)
    lags = [p[0, [lag.middle, lag.end]] for lag in (P.steering, P.motor)]

    def split_blocks(rows: Array) -> Array:
        return np.ascontiguousarray(rows.reshape(-1, LANES, rows.shape[1]).transpose(0, 2, 1))

    return Cars(
        np.concatenate(lags),
        split_blocks(p[:, P.car]),
        split_blocks(p[:, P.road]),
        split_blocks(rng.normal(0.0, 1.0, (count, 3)) * [50.0, 20.0, 0.0]),
        split_blocks(rng.uniform(-1.0, 1.0, (count, 3)) * [0.05, 20.0, 20.0]),
        split_blocks(z[:, Z.motion]),
        split_blocks(np.zeros((count, 3))),
    )


@jit
def _advance(lanes: Cars, ticks: int) -> None:
    """Move all cars by some ticks of Kutta's three stages, a block at a time."""
    remaining, variant = lanes.remaining, PlantVariant(0, FIALA, 1)
    for b in range(len(lanes.cars)):
        car, road = read(lanes.cars[b], _CAR), read(lanes.roads[b], _ROAD)
        push, command = read(lanes.pushes[b], _PUSH), read(lanes.commands[b], _INPUTS)
        motion, applied = read(lanes.motions[b], _MOTION), read(lanes.acting[b], _INPUTS)
        load = compute_tyre_load(applied, car, variant)
        for _ in range(ticks):
            between = TyreInputs(
                apply_lag(command.delta_f, applied.delta_f, remaining[0]),
                apply_lag(command.T_l, applied.T_l, remaining[2]),
                apply_lag(command.T_r, applied.T_r, remaining[2]),
            )
            applied = TyreInputs(
                apply_lag(command.delta_f, applied.delta_f, remaining[1]),
                apply_lag(command.T_l, applied.T_l, remaining[3]),
                apply_lag(command.T_r, applied.T_r, remaining[3]),
            )
            middle = compute_tyre_load(between, car, variant)
            first, load = load, compute_tyre_load(applied, car, variant)
            loads = (first, middle, load)
            motion = kutta3(motion, loads, push, car, road, TICK, variant)
        write(lanes.motions[b], motion, _MOTION)
        write(lanes.acting[b], applied, _INPUTS)


def make_c_advance() -> _Advance:
    """Make the function that moves cars in C; RuntimeError where its numbers are not ours."""
    function = _load_c_plant()

    def advance_in_c(cars: Cars, ticks: int) -> None:
        function(len(cars.cars), ticks, TICK, *(array.ctypes.data for array in cars))

    numba_cars = _make_cars(LANES)
    c_cars = numba_cars.clone()
    _advance(numba_cars, 100)
    advance_in_c(c_cars, 100)
    if not np.allclose(c_cars.motions, numba_cars.motions, rtol=1e-9, atol=1e-12):
        off = np.abs(c_cars.motions - numba_cars.motions).max()
        raise RuntimeError(f"the plant in C is not ours: they differ by {off:.3g} after 0.1 s")
    return advance_in_c


def _make_workload(advance: _Advance, cars: Cars) -> Workload:
    """Make calls that move cars by `_TICKS`, in every round from the same state on."""
    running = cars.clone()

    def reset_cars() -> None:
        running.motions[:], running.acting[:] = cars.motions, cars.acting

    return Workload(lambda: advance(running, _TICKS), CARS * _TICKS, reset_cars)


def measure_plants(effort: Effort) -> TimeTable:
    """Measure both plants; without a compiler the one in C is absent."""
    note = (
        f"One car, one millisecond: lag, load, Fiala tyres, roll, Kutta's rule; {CARS} cars at "
        "once. The C is the same text in blocks of as many cars, compiled on the spot "
        "(-O3 -march=native, no fused multiply-add), with the same numbers."
    )
    cars = _make_cars(CARS)
    table = TimeTable("Cost of a tick of the plant", "us_per_tick", "us per tick", note)
    workloads = {
        PLANT: lambda: _make_workload(_advance, cars),
        C: lambda: _make_workload(make_c_advance(), cars),
    }
    return table.measure(workloads, effort)
