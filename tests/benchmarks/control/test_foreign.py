"""A controller, an estimator's reader and a scenario of a user's own are contestants like ours."""

from typing import Any

import numpy as np

from sideslip.agents import Controller
from sideslip.benchmarks.control.entries import ControlCase, Entry
from sideslip.benchmarks.control.run import measure, measure_decision_time
from sideslip.benchmarks.control.score import rank_entries
from sideslip.benchmarks.control.tasks import ControlTask
from sideslip.benchmarks.harness.results import Suite

MINE: dict[str, Any] = {
    "name": "my bend",
    "steering": "held-step",
    "amplitude": (0.03, 0.05),
    "front_stiffness": (0.8, 1.2),
    "mirror": True,
    "duration": 2.0,
}


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
