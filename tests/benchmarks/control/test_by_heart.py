"""Nobody wins by heart: open-loop actions made for known seeds are worth nothing on salted ones.

The cheater has a plan for each public seed, found by the cross-entropy method, and drives the plan
of the seed whose first observation is most like what it sees.
"""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import Controller
from sideslip.agents.rollout import COST_FLOOR, evaluate_episodes
from sideslip.benchmarks.control.entries import ControlCase, Entry
from sideslip.benchmarks.control.run import measure, measure_decision_time
from sideslip.benchmarks.control.score import rank_entries
from sideslip.benchmarks.control.tasks import YAW, ControlTask, make_salt, make_task_seeds
from sideslip.benchmarks.harness.results import Suite

CONTEST = ControlTask("", YAW, "coms", "zero-slip", "coms-random")
PUBLIC = (0, 1, 2)
KNOTS, TRIES, BEST, TURNS = 24, 96, 12, 12


class OpenLoop:
    """Rows of knots (N, KNOTS), straight between them over `steps` decisions."""

    def __init__(self, knots: Any, steps: int) -> None:
        self.knots, self.at = knots, np.linspace(0.0, KNOTS - 1.001, steps)

    def predict(
        self, obs: Any, state: Any = None, start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        step = 0 if state is None else state
        i, part = divmod(self.at[min(step, len(self.at) - 1)], 1.0)
        here, there = self.chosen(obs, step)[:, int(i) : int(i) + 2].T
        return ((1.0 - part) * here + part * there)[:, None].astype(np.float32), step + 1

    def chosen(self, obs: Any, step: int) -> Any:
        return self.knots


class Cheater(OpenLoop):
    """seen: (plans, k), the first observations of the plans' seeds."""

    def __init__(self, knots: Any, steps: int, seen: Any) -> None:
        super().__init__(knots, steps)
        self.seen, self.scale = seen, np.maximum(seen.std(axis=0), 1e-9)

    def chosen(self, obs: Any, step: int) -> Any:
        if step == 0:
            apart = (obs[:, None, :] - self.seen) / self.scale
            self.own = self.knots[np.argmin((apart**2).sum(axis=2), axis=1)]
        return self.own


def made(cars: int) -> Any:
    return gym.make_vec(CONTEST.env_id, num_envs=cars, **CONTEST.env_options)


def steps_of_an_episode() -> int:
    env: Any = gym.make(CONTEST.env_id, **CONTEST.env_options)
    base = env.unwrapped
    return round(float(base.scenario.duration) / (1e-3 * int(base.control_period)))


def plan_for(seed: int, env: Any, steps: int) -> Any:
    """(KNOTS,) found by the cross-entropy method on one seed."""
    rng, middle, spread = np.random.default_rng(seed), np.zeros(KNOTS), np.full(KNOTS, 0.3)
    for _ in range(TURNS):
        tries = np.clip(rng.normal(middle, spread, (TRIES, KNOTS)), -1.0, 1.0)
        tries[0] = middle
        costs = evaluate_episodes(env, OpenLoop(tries, steps), [seed] * TRIES)[0]
        best = tries[np.argsort(costs)[:BEST]]
        middle, spread = best.mean(axis=0), best.std(axis=0) + 0.01
    return middle


def gained(env: Any, agent: Any, seeds: Any) -> Any:
    """(N,) paired log ratios of no control's cost to an agent's."""
    none, own = (evaluate_episodes(env, each, seeds)[0] for each in (None, agent))
    return np.log((none + COST_FLOOR) / (own + COST_FLOOR))


@pytest.mark.long
def test_what_is_known_by_heart_is_worth_nothing_on_salted_seeds() -> None:
    steps, env = steps_of_an_episode(), made(TRIES)
    plans = np.array([plan_for(seed, env, steps) for seed in PUBLIC])
    few = made(len(PUBLIC))
    first, _ = few.reset(seed=list(PUBLIC))
    cheater = Cheater(plans, steps, first)
    known = gained(few, cheater, PUBLIC)
    salted = gained(env, cheater, make_task_seeds(make_salt(), TRIES)(CONTEST))
    assert known.min() > 1.0
    assert salted.mean() < 0.1


MINE: dict[str, Any] = {
    "name": "my bend", "steering": "held-step", "amplitude": (0.03, 0.05),
    "front_stiffness": (0.8, 1.2), "mirror": True, "duration": 2.0,
}  # fmt: skip


class Damper(Controller):
    """A yaw moment against the estimated sideslip angle."""

    needs = ("beta_hat",)

    def _law(self, inputs: Any, state: Any, action: Any) -> None:
        action[:, 0] = 20.0 * inputs[:, 0]


BEND = ControlTask(scenario=MINE["name"], changes={"scenario": MINE})


def cell(agent: str, estimator: str = "") -> ControlCase:
    return ControlCase(BEND, Entry(agent, estimator))


def test_a_users_controller_on_a_users_scenario_stands_in_the_tables() -> None:
    mine = cell(f"{__name__}:Damper", "bicycle-kf")
    asked = [mine, *(cell(who) for who in ("none", "nominal", "oracle-state"))]
    found = measure(asked, range(6), jobs=2)
    assert not any(driven.error for driven in found.values())
    ours, none = found[mine], found[cell("none")]
    assert np.median(ours["rms_slip"] / none["rms_slip"]) < 0.95  # it does what it is for
    table = rank_entries(found, "")
    standing = {each.entry: each for each in table}[mine.entry]
    suite = Suite("control", "", "")
    standing.add_rows(suite, "ab")
    rows = suite.rows
    assert {row.scenario for row in rows} == {"my bend, yaw", "tier "}
    assert {row.metric for row in rows} >= {"score", "cost_vs_nominal", "share_won"}
    assert {row.controller for row in rows} == {mine.entry.agent}
    assert all("my bend" in row.spec for row in rows if row.scenario == BEND.name)
    assert measure_decision_time(mine) > 0.0
