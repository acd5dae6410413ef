"""A controller, an estimator's reader and a scenario of a user's own are contestants like ours."""

from typing import Any

import numpy as np
import pytest

from sideslip.agents import Controller
from sideslip.benchmarks.control.build import decision_time
from sideslip.benchmarks.control.cells import Cell
from sideslip.benchmarks.control.contests import Contest
from sideslip.benchmarks.control.ladder import yardsticks
from sideslip.benchmarks.control.run import measure
from sideslip.benchmarks.control.tables import rows_of, standings

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


BEND = Contest(scenario=MINE["name"])


def cell(controller: str, estimator: str = "") -> Cell:
    return Cell(BEND, estimator, controller, {"scenario": MINE})


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_users_controller_on_a_users_scenario_stands_in_the_tables(jobs: int) -> None:
    mine = cell(f"{__name__}:Damper", "bicycle-kf")
    asked = [mine, *(cell(who) for who in ("none", "nominal", "oracle-state"))]
    found = measure(asked, range(6), jobs=jobs)
    assert not any(driven.error for driven in found.found.values())
    ours, none = found.found[mine], found.found[cell("none")]
    assert np.median(ours["rms_slip"] / none["rms_slip"]) < 0.95  # it does what it is for
    table = standings(found.found, "", yardsticks(found, [BEND]))
    standing = {each.cell.controller: each for each in table}[mine.controller]
    rows = rows_of(standing, "ab")
    assert {row.scenario for row in rows} == {"my bend, yaw", "tier "}
    assert {row.metric for row in rows} >= {"score", "cost_vs_nominal", "share_won"}
    assert {row.controller for row in rows} == {mine.controller}
    assert all("my bend" in row.spec for row in rows if row.scenario == BEND.name)
    assert decision_time(mine) > 0.0
