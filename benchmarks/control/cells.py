"""The matrix: manoeuvres, estimators, controllers, and the cells they make."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

YAW = "sideslip/YawFusion-v0"
STEERING = "sideslip/AfsYawFusion-v0"

MANOEUVRES = (
    *("random-steering", "sine-with-dwell", "double-lane-change", "step-steer", "gust"),
    *("low-friction", "brake-in-turn", "stiffness-step", "sensor-outage", "uneven-delay"),
)

TRUTH, REFERENCE_FILTER, REFERENCE_CONTROLLER = "truth", "exact-kf", "two-dof"
ESTIMATORS = (
    *("bicycle-kf", "single-rate-kf", "multirate-residual-kf", "uneven-delay-kf", "dakf"),
    *(REFERENCE_FILTER, TRUTH),
)
OTHER_ESTIMATORS = (
    *("multirate-kf", "constant-delay-kf", "vision-only-kf", "course-kf", "double-layer"),
    *("dual-rate", "lob", "lob-2"),
)
BLIND = ("none", "feedforward")
"""Controllers that ignore the estimate: one cell a manoeuvre."""
SEEING = ("esc", REFERENCE_CONTROLLER, "sliding-mode", "lqr")
STEERING_CONTROLLERS = ("model-following", "lqr", "two-dof", "esc")
INFORMED = "informed"
SLOW_CONTROLLERS = ("mpc",)
LEARNED: dict[str, tuple[tuple[str, str], ...]] = {
    YAW: (("", "ppo-yaw-vision"),),
    STEERING: (("", "ppo-yaw-vision"),),
}
"""(estimator, policy) in each table, a policy by its shipped name or path. One that was trained on
fewer sensors reads what it knows by name."""

EPISODES, QUICK_EPISODES, SLOW_EPISODES = 1000, 16, 64


@dataclass(frozen=True)
class Cell:
    """One square of the matrix.

    estimator: a name of `make_estimator`, "truth", or "" where the controller reads none (or
    brings its own). controller: a name of `make_agent`. options: of the env, a scenario that has no
    name among them; cells are equal whatever theirs are.
    """

    env_id: str
    scenario: str
    estimator: str
    controller: str
    options: dict[str, Any] = field(default_factory=dict, compare=False)

    @property
    def label(self) -> str:
        """Controller and estimator in words."""
        return f"{self.controller} on {self.estimator}" if self.estimator else self.controller

    @property
    def env_options(self) -> dict[str, Any]:
        """Options of the env: an action that is none ends the episode."""
        return {"scenario": self.scenario, "on_bad_action": "fail"} | self.options

    @property
    def slow(self) -> bool:
        """Whether it takes so long to decide that it gets fewer episodes."""
        return self.controller in SLOW_CONTROLLERS


def cells(manoeuvres: tuple[str, ...] = MANOEUVRES) -> Iterator[Cell]:
    """Every cell of both tables, manoeuvre by manoeuvre."""
    for scenario in manoeuvres:
        for controller in (*BLIND, INFORMED):
            yield Cell(YAW, scenario, "", controller)
        for estimator, policy in LEARNED[YAW]:
            yield Cell(YAW, scenario, estimator, policy)
        for controller in SEEING:
            for estimator in ESTIMATORS:
                yield Cell(YAW, scenario, estimator, controller)
        for estimator in OTHER_ESTIMATORS:
            yield Cell(YAW, scenario, estimator, REFERENCE_CONTROLLER)
        for controller in SLOW_CONTROLLERS:
            yield Cell(YAW, scenario, REFERENCE_FILTER, controller)
        for controller in (*BLIND, INFORMED):
            yield Cell(STEERING, scenario, "", controller)
        for estimator, policy in LEARNED[STEERING]:
            yield Cell(STEERING, scenario, estimator, policy)
        for controller in STEERING_CONTROLLERS:
            yield Cell(STEERING, scenario, REFERENCE_FILTER, controller)
        yield Cell(STEERING, scenario, "dakf", "model-following")  # the paper's own pair
