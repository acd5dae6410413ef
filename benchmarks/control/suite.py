"""The suite `control`: which estimator and controller hold the car, and how far from the oracles?

All pairs of both drive the scored tasks of four tiers on salted seeds.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from ..harness.results import Suite
from ..report.study import Request, Study
from .baseline_gaps import DELAY_TASK, DELAYS, measure_delay_cost
from .calibration import measure_regrets, read_current
from .entries import EPISODES, QUICK_EPISODES, ControlCase, Entry, make_cases, select_quick_tasks
from .report import add_figures, compose_verdict, make_tracks
from .run import measure, measure_decision_time
from .score import rank_entries
from .tables import Matrix, make_tables
from .tasks import QUICK_LEAD_IN, TITLES, list_scored_tasks, make_salt, make_task_seeds


def _measure(request: Request) -> Matrix:
    """Drive all tiers; unless it is quick, on the clairvoyant's seeds and with late sensors too."""
    shared: Any = {"jobs": request.jobs, "console": request.console, "keep": request.keep}
    salt, tasks = request.salt or make_salt(), list(list_scored_tasks())
    tasks = request.choose(tasks, select_quick_tasks(tasks, 1))
    if request.quick:
        tasks = [replace(task, changes={"lead_in": QUICK_LEAD_IN}) for task in tasks]
    cases = list(make_cases(tasks, request.quick))
    wanted = not request.quick or request.clairvoyant is not None
    records = read_current(request.clairvoyant, tasks) if wanted else {}
    seeds = make_task_seeds(salt, request.episodes or 0)  # `Study.run` has filled them in
    results = measure(cases, seeds, **shared)
    regrets, calibrated = measure_regrets(records, cases, **shared)
    driven = {task.tier for task in tasks}
    ranked = {tier: rank_entries(results, tier) for tier in TITLES if tier in driven}
    matrix, times = Matrix(results, ranked, salt, regrets), dict[Entry, float]()
    if not request.quick:
        matrix.delay_costs, matrix.late = measure_delay_cost(seeds(DELAY_TASK), **shared)
    for standing in (item for standings in ranked.values() for item in standings):
        if standing.drives:  # an entry takes as long in every tier
            if standing.entry not in times:
                case = ControlCase(next(iter(standing.drives)), standing.entry)
                times[standing.entry] = measure_decision_time(case)
            standing.us = times[standing.entry]
    runs = (results, calibrated, *(late for _, late in matrix.late))
    matrix.seconds = float(np.nansum([drive.seconds for run in runs for drive in run.values()]))
    return matrix


def _add_tables(suite: Suite, matrix: Matrix) -> None:
    """Add rows, tables and tracks; a row of the cost of delay has the delay in its scenario."""
    for standing in (item for standings in matrix.by_tier.values() for item in standings):
        standing.add_rows(suite, matrix.salt)
    n = max((len(drive.costs) for drive in matrix.results.values()), default=0)
    for entry, costs in matrix.delay_costs.items():
        labels = {"estimator": entry.estimator, "controller": entry.agent, "salt": matrix.salt}
        for delay, ratio in zip(DELAYS, costs, strict=True):
            where = f"{DELAY_TASK.name}, sensors {1e3 * delay:.0f} ms late"
            line: dict[str, Any] = {"cost_vs_nominal": ratio, "scenario": where}
            suite.add_rows([line], DELAY_TASK.env_id, n=n, **labels)
    suite.tables = make_tables(matrix)
    suite.files = make_tracks(matrix)
    suite.text += f" Driven in {matrix.seconds / 60.0:.1f} CPU-minutes."


STUDY = Study(
    "control",
    "Which controller and estimator hold the car",
    """\
In a task everybody drives the same salted seeds, with errors of car and sensors that nobody is \
told, after 20 s of gentle driving (4 s in a quick run), and everything is paired by drive. \
`nominal` is the LQG that knows the nominal car, `oracle-parameters` knows car, friction and \
errors, `oracle-state` the state too. r is log((J_nominal + J_0) / (J + J_0)), where J_0 is the \
cost of 0.25 deg of slip and 0.5 deg/s, over drives that both finish; 2 where nominal alone loses \
the car, -2 where the entry alone does. The score is the mean r. Entries that surely lose more \
cars than nominal stand below a line. Intervals are 95 %. contests.json says what each task \
demands.""",
    (EPISODES, QUICK_EPISODES),
    _measure,
    _add_tables,
    compose_verdict,
    add_figures,
)
