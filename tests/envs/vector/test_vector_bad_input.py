"""A vector env refuses bad input at the border, names the rows, and steps nothing."""

import math
from typing import Any

import numpy as np
import pytest

from sideslip.envs import FAILURES

from ..batches import batch, plain
from ..helpers import BAD_ACTIONS

pytestmark = pytest.mark.plain

FUSION, AFS = "sideslip/YawFusion-v0", "sideslip/AfsYawFusion-v0"


BAD: list[tuple[Any, str]] = [
    (np.array([[0], [np.nan], [0]]), r"the action of row 1 is not finite, \[nan\]; nothing was"),
    (np.array([[np.inf], [0], [np.nan]]), r"rows 0, 2 \(2 of them\) is not finite, \[inf\]"),
    (np.zeros((2, 1)), r"actions have shape \(3, 1\), got 2 rows; nothing was stepped"),
    (np.zeros((0, 1)), r"shape \(3, 1\), got 0 rows"),
    (np.zeros((3, 2)), r"shape \(3, 1\), got in rows 0, 1, 2 \(3 of them\) shape \(2,\)"),
    (np.zeros(3), r"shape \(3, 1\), got in rows 0, 1, 2 \(3 of them\) shape \(\)"),
    *(([[0.0], action, [0.0]], f"got in row 1 {text}") for action, text in BAD_ACTIONS),
    ([[0.0], [[0.0], [0.0, 0.0]], {}], r"got in rows 1, 2 \(2 of them\) \[\[0.0\], .*inhomogen"),
    (0.5, "got 0 rows"),
    (None, "got 0 rows"),
    ({}, "got 0 rows"),
]


@pytest.mark.smoke
@pytest.mark.parametrize(("actions", "message"), BAD, ids=lambda told: str(told)[:40])
def test_bad_actions_are_refused_and_nothing_is_stepped(actions: Any, message: str) -> None:
    env, untouched = batch(FUSION, 3), batch(FUSION, 3)
    still = np.zeros((3, 1))
    for each in (env, untouched):
        each.reset(seed=0)
        each.step(still)
    with pytest.raises(ValueError, match=message):
        env.step(actions)
    assert plain(env.get_state()["states"]) == plain(untouched.get_state()["states"])
    for _ in range(5):
        assert plain(env.step(still)) == plain(untouched.step(still))


ROWS: list[tuple[Any, list[int]]] = [
    (np.array([[0], [np.nan], [0]]), [1]),
    (np.array([[np.inf], [0], [-np.inf]]), [0, 2]),
    *(([[0.0], action, [0.0]], [1]) for action, _ in BAD_ACTIONS),
    ([["left"], [0.0], {}], [0, 2]),
    (np.zeros((3, 2)), [0, 1, 2]), (np.zeros((2, 1)), [0, 1, 2]), (None, [0, 1, 2]),
    ({}, [0, 1, 2]), ("left", [0, 1, 2]),
]  # fmt: skip


@pytest.mark.parametrize(("actions", "rows"), ROWS, ids=lambda told: str(told)[:40])
def test_on_bad_action_fail_ends_these_rows_only(actions: Any, rows: list[int]) -> None:
    """The rest of their episodes is charged; their neighbours keep their bits."""
    env, untouched = batch(FUSION, 3, on_bad_action="fail"), batch(FUSION, 3)
    for each in (env, untouched):
        each.reset(seed=0)
        each.step(np.zeros((3, 1)))
    one, other = env.step(actions), untouched.step(np.zeros((3, 1)))
    failed = np.isin(range(3), rows)
    assert one[2].tolist() == failed.tolist() and not one[3].any()
    assert {FAILURES[code] for code in one[4]["failure"][failed]} == {"bad-action"}
    np.testing.assert_allclose(one[1][failed], -100.0 * (10.0 - 0.01), rtol=1e-15)
    assert not one[0][failed].any()
    told: Any = zip(one[:4], other[:4], strict=True)
    for first, second in told:
        assert plain(first[~failed]) == plain(second[~failed])
    assert [len(env.record[i].fast) for i in range(3)] == [0 if bad else 10 for bad in failed]


def test_actions_of_rows_that_are_reset_are_not_read() -> None:
    env = batch(FUSION, 2, scenario={"base": "straight", "duration": 0.01})
    env.reset(seed=0)
    assert env.step(np.zeros((2, 1)))[3].all()
    _, rewards, terminated, truncated, infos = env.step(np.full((2, 1), math.nan))
    assert rewards.tolist() == [0.0, 0.0] and not (terminated | truncated).any()
    assert infos["t"].tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match=r"rows 0, 1 \(2 of them\) is not finite"):
        env.step(np.full((2, 1), math.nan))


def test_either_number_of_an_action_may_be_bad() -> None:
    env = batch(AFS, 2)
    env.reset(seed=0)
    for bad in ([[0.0, math.nan], [0.0, 0.0]], [[math.inf, -math.inf], [0.0, 0.0]]):
        with pytest.raises(ValueError, match="the action of row 0 is not finite"):
            env.step(np.array(bad))
    with pytest.raises(ValueError, match=r"shape \(2, 2\), got in rows 0, 1 .* shape \(1,\)"):
        env.step(np.zeros((2, 1)))
