"""An episode's arrays in one vector, and verdicts on all ticks of a step at once.

That compiled code finds the parts where Python does, `test_whole_steps` shows.
"""

import copy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sideslip.envs import StabilityEnv
from sideslip.envs.engine.views import _make_workspace, split_workspace
from sideslip.envs.numerics.jit import as_python

from ..helpers import bits

SPINS = {"v_x": 15.0, "v_y": 8.0, "gamma": -1.0}


@pytest.mark.parametrize("entries", [4, 5])
@pytest.mark.parametrize("n", [1, 10, 33])
def test_every_part_has_a_place_of_its_own(n: int, entries: int) -> None:
    shape: Any = {"layout": (None,) * entries, "max_packets": 3, "bounds": np.zeros((2, entries))}
    work = _make_workspace(SimpleNamespace(control_period=n, **shape), trace_width=2)  # type: ignore[arg-type]
    parts = as_python(split_workspace)(work)
    for k, part in enumerate(parts):
        part[...] = k + 1
    assert all((part == k + 1).all() for k, part in enumerate(parts))
    assert sum(part.nbytes for part in parts) // 8 in (work.size - 4, work.size - 3)


def test_a_copy_has_an_episode_of_its_own() -> None:
    env = StabilityEnv("fusion")
    env.reset(seed=1)
    env.step([0.5])
    other = copy.deepcopy(env)
    before = bits(env.get_state()["state"])
    obs = other.step([0.1])[0]
    assert bits(env.get_state()["state"]) == before
    assert bits(env.step([0.1])[0]) == bits(obs)
    assert np.shares_memory(other.rows, other._workspace.vector)


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
