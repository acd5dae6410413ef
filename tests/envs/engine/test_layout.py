"""State by name: every number of an episode has one place, compiled code reads it there."""

from collections.abc import Iterator
from typing import Annotated, Any, NamedTuple

import numpy as np
import pytest

from sideslip.envs import StabilityEnv
from sideslip.envs.engine.layout import (
    FLAGS,
    PARAMS_WIDTH,
    SLOW_STATE,
    SLOW_WIDTH,
    STATE_WIDTH,
    P,
    Z,
)
from sideslip.envs.numerics.jit import jit
from sideslip.envs.numerics.packed import make_offsets, read, write
from sideslip.envs.record import PACKET_WIDTH
from sideslip.envs.sensors.link import MAX_IN_FLIGHT

from ..helpers import bits

QUEUE = len(Z.slow) * MAX_IN_FLIGHT * PACKET_WIDTH


def leaves(part: Any) -> Iterator[int]:
    if isinstance(part, tuple):
        for each in part:
            yield from leaves(each)
    else:
        yield part


@pytest.mark.parametrize(
    ("part", "width"), [(P, PARAMS_WIDTH), (SLOW_STATE, SLOW_WIDTH), (FLAGS, len(FLAGS))]
)
def test_every_number_has_a_place_of_its_own(part: Any, width: int) -> None:
    assert list(leaves(part)) == list(range(width))


def test_of_the_state_only_the_queue_has_room_for_more_numbers_than_names() -> None:
    queued = range(Z.queue + 1, Z.queue + QUEUE)
    assert sorted([*leaves(Z), *queued]) == list(range(STATE_WIDTH))


def test_what_a_tick_of_the_plant_changes_lies_before_the_slow_sensors() -> None:
    """The lanes copy that alone, and the driver's angle."""
    changed = Z.motion, Z.drive, Z.clock, Z.refs, Z.nominal_motion
    assert max(leaves(changed)) + 1 == Z.errors[0]  # in an ideal world
    assert max(leaves((*changed, Z.errors, Z.past_efforts))) + 1 == Z.slow[0].frames


class Wheel(NamedTuple):
    slip: Any
    load: Any


class Cart(NamedTuple):
    mass: Any
    wheels: Annotated[tuple[Wheel, ...], 3]
    trail: Annotated[Any, 5]
    last: Any


CART, CART_WIDTH = make_offsets(Cart)


@jit
def sum_of_loads(vector: Any) -> Any:
    total = 0.0
    for k in range(len(CART.wheels)):
        wheel = read(vector, CART.wheels[k])
        write(vector, (wheel.load, wheel.slip), CART.wheels[k])
        total = total + wheel.load
    return total + vector[CART.last]


def test_parts_are_read_and_written_by_name_in_compiled_loops() -> None:
    wheels = (Wheel(1, 2), Wheel(3, 4), Wheel(5, 6))
    assert (Cart(0, wheels, 7, 12), 13) == (CART, CART_WIDTH)
    vector = np.arange(13.0)
    assert sum_of_loads(vector) == 2.0 + 4.0 + 6.0 + 12.0
    assert vector[:8].tolist() == [0.0, 2.0, 1.0, 4.0, 3.0, 6.0, 5.0, 7.0]
    assert read(vector, CART.wheels[1]) == Wheel(4.0, 3.0)
    matrix = np.arange(26.0).reshape(13, 2)
    assert read(matrix, CART.wheels[0], 1) == Wheel(3.0, 5.0)
    write(matrix, (0.5, 0.25), CART.wheels[0], 1)
    assert matrix[1:3].tolist() == [[2.0, 0.5], [4.0, 0.25]]


SPINS = {"v_x": 15.0, "v_y": 8.0, "gamma": -1.0}


@pytest.mark.parametrize("n", [7, 10, 50])
def test_a_car_that_spins_within_a_step_ends_at_that_tick(n: int) -> None:
    def driven(period: int) -> tuple[StabilityEnv, int]:
        env = StabilityEnv("fusion", control_period=period)
        env.reset(seed=4, options={"state": SPINS})
        ticks = 0
        while not env.step([0.0])[2]:
            ticks += period
        return env, ticks + env.ticks_done

    (slow, last), (quick, same) = driven(1), driven(n)
    assert same == last and last % n, "it is to end in mid-step"
    assert quick.motion == slow.motion
    assert bits(quick.rows[quick.ticks_done - 1]) == bits(slow.rows[0])
    ours, theirs = quick.get_state()["report"], slow.get_state()["report"]
    assert ours[[1, 9]].tolist() == theirs[[1, 9]].tolist() and ours[9] == 1.0
