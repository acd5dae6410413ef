"""A controller, an estimator's reader and a scenario of a user's own are contestants like ours."""

from typing import Any

import numpy as np
import pytest

from sideslip.agents import Controller
from sideslip.benchmarks.control.baseline_gaps import make_score_scales
from sideslip.benchmarks.control.entries import ControlEntry, measure_decision_time
from sideslip.benchmarks.control.run import measure
from sideslip.benchmarks.control.score import make_rows, rank_entries
from sideslip.benchmarks.control.tasks import ControlTask

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


BEND = ControlTask(scenario=MINE["name"])


def cell(controller: str, estimator: str = "") -> ControlEntry:
    return ControlEntry(BEND, estimator, controller, {"scenario": MINE})


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_users_controller_on_a_users_scenario_stands_in_the_tables(jobs: int) -> None:
    mine = cell(f"{__name__}:Damper", "bicycle-kf")
    asked = [mine, *(cell(who) for who in ("none", "nominal", "oracle-state"))]
    found = measure(asked, range(6), jobs=jobs)
    assert not any(driven.error for driven in found.outcomes.values())
    ours, none = found.outcomes[mine], found.outcomes[cell("none")]
    assert np.median(ours["rms_slip"] / none["rms_slip"]) < 0.95  # it does what it is for
    table = rank_entries(found.outcomes, "", make_score_scales(found, [BEND]))
    standing = {each.entry.controller: each for each in table}[mine.controller]
    rows = make_rows(standing, "ab")
    assert {row.scenario for row in rows} == {"my bend, yaw", "tier "}
    assert {row.metric for row in rows} >= {"score", "cost_vs_nominal", "share_won"}
    assert {row.controller for row in rows} == {mine.controller}
    assert all("my bend" in row.spec for row in rows if row.scenario == BEND.name)
    assert measure_decision_time(mine) > 0.0
