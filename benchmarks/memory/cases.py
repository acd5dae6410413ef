"""Who is trained and judged in which condition, and what a training may use."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import gymnasium as gym

from ...agents.optimum import Optimum, compute_optimum
from ...envs.arguments import check_choice

ID = "sideslip/LinearYawVision-v0"
PERIOD, STEP = 0.04, 0.01  # s, of pictures and of control
CONDITIONS: Mapping[str, Mapping[str, Any]] = {
    "100 ms": {"delays": [0.1]},
    "300 ms": {"delays": [0.3]},
    "0 ms": {"delays": [0.0]},
    "100 ms, half lost": {"delays": [0.1], "loss": 0.5},
    "300 ms, half lost": {"delays": [0.3], "loss": 0.5},
}
"""How late pictures are, and which share never comes."""
REPEATED, SEEDS = "100 ms", 3
"""The condition in which everybody trains on so many seeds; elsewhere on one."""
SCHEDULES = 8  # whose arrivals the optimum is averaged over, where pictures are lost
FILTER, PPO, LQG_FACTOR = "lqg", "ppo", 8
"""The optimum's own policy, as a check, on so many times the episodes; learning from rewards."""
EPISODES, QUICK_EPISODES = 64, 16


@dataclass(frozen=True)
class Budget:
    """What a training may use.

    cars: side by side. rounds: of driving and learning. epochs: passes over all drives in a round.
    ppo: steps of PPO, 0 for none. duration: s, of an episode.
    """

    cars: int = 64
    rounds: int = 3
    epochs: int = 1
    ppo: int = 500_000
    duration: float = 10.0


QUICK = Budget(cars=32, rounds=2, epochs=1, ppo=0, duration=3.0)


@dataclass(frozen=True)
class MemoryCase:
    """Who, in which condition, trained with which seed and budget; so many episodes judge it."""

    learner: str
    condition: str
    seed: int
    budget: Budget
    episodes: int

    @property
    def options(self) -> dict[str, Any]:
        """Of the env."""
        spec = gym.spec(ID).kwargs
        camera = {"period": PERIOD} | dict(CONDITIONS[self.condition])
        return {"camera": camera, "scenario": spec["scenario"] | {"duration": self.budget.duration}}

    @property
    def delay_steps(self) -> int:
        """Steps that a picture is old when it arrives."""
        return round(float(CONDITIONS[self.condition]["delays"][0]) / STEP)

    @property
    def best(self) -> Optimum:
        """The optimum."""
        return _compute_best(self.condition, self.budget)


@cache
def _compute_best(condition: str, budget: Budget) -> Optimum:
    options = MemoryCase("", condition, 0, budget, 1).options
    return compute_optimum(gym.make(ID, **options), SCHEDULES if "loss" in options["camera"] else 1)


def make_cases(
    quick: bool,
    episodes: int | None = None,
    conditions: Sequence[str] = (),
    seeds: int = SEEDS,
) -> list[MemoryCase]:
    """What a run trains, the repeated seeds last; arguments as of the suite's `run`."""
    from ...agents.training.memory.networks import MEMORIES

    for item in conditions:
        check_choice("condition", item, CONDITIONS)
    budget, default = (QUICK, (REPEATED,)) if quick else (Budget(), tuple(CONDITIONS))
    conditions = list(dict.fromkeys((REPEATED, *conditions))) if conditions else default
    count = episodes or (QUICK_EPISODES if quick else EPISODES)
    learners = (FILTER, *MEMORIES)
    cases = [
        MemoryCase(name, condition, 0, budget, count)
        for condition in conditions
        for name in learners
    ]
    if not quick:
        cases.append(MemoryCase(PPO, REPEATED, 0, budget, count))
        repeated = [
            item for item in cases if item.condition == REPEATED and item.learner in MEMORIES
        ]
        cases += [replace(item, seed=seed) for seed in range(1, seeds) for item in repeated]
    return cases
