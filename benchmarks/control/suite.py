"""Question: which estimator with which controller keeps the car where it should be, and how far is
that from the best possible? The matrix of both on ten manoeuvres."""

from pathlib import Path

from rich.console import Console

from ... import __version__
from ...agents.learned.files import is_policy, load_policy
from ..harness.results import Row, Suite, Table
from .ceiling import calibrated_by, judged, refusals_of, tops_of
from .cells import EPISODES, LEARNED, STEERING, YAW, cells
from .decision_time import decision_time
from .delay_price import DELAYS, SCENARIO, Price, price_of_delay
from .figures import illustrate
from .run import Results, measure
from .seeds import salt_of, salted_seeds
from .tables import Standing, main_table, motion_table, rows_of, standings, yardsticks

PRICE_SHARE = 0.2  # of the matrix's episodes
TITLES = {YAW: "Yaw moment by two motors", STEERING: "Yaw moment and added steering"}
_TEXT = """\
Ten manoeuvres with drawn tyres, friction, speed and steering; camera (33 ms, 30 ms late), GPS and \
gyro; everybody, the uncontrolled car included, drives the same salted seeds. score: 0 is the \
uncontrolled car, 1 the clairvoyant optimum, which knows the truth and the disturbances ahead; \
IQM is the interquartile mean of the episodes' scores. `informed` is the LQG of the true car with \
the same sensors, as it is at the start: cost / informed is 1 where nothing better can be made of \
them on a linear plant whose tyres do not change. \
Intervals are 95 % bootstraps, stratified by manoeuvre.

An estimator uses its own sensors only, camera or GPS; "truth" is an estimator without error. \
Controllers know the nominal car alone."""


def run(
    episodes: int = EPISODES,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
) -> Suite:
    """Both tables, the price of delay, and pictures.

    episodes: a cell (slow controllers have at most 64). keep: a folder in which finished cases
    stay, so that a run that was stopped goes on.
    """
    salt = salt_of()
    suite = Suite("control", "Which controller and estimator hold the car", _TEXT)
    results = measure(list(cells()), episodes, salt=salt, jobs=jobs, console=console, keep=keep)
    found, tops, yard, more = {}, {}, [], []
    for env_id, title in TITLES.items():
        tops[env_id], log = tops_of(results, env_id)
        found[env_id] = standings(results, env_id, tops[env_id])
        for each in found[env_id]:
            if not any(result.error for result in each.results.values()):
                each.us = decision_time(each.cell)
            suite.rows += rows_of(each, salt)
        note = " ".join([_note(found[env_id], episodes), *_learned(env_id), *log])
        suite.tables.append(main_table(f"{title} ({env_id})", found[env_id], note))
        more.append(motion_table(f"{title}: the motion", found[env_id]))
        yard.append(yardsticks(results, env_id, tops[env_id]))
    suite.tables += [*yard, *more]
    share = max(4, round(PRICE_SHARE * episodes))
    top = tops[YAW][SCENARIO] if SCENARIO in judged(results, YAW, tops[YAW]) else None
    prices, late = price_of_delay(top, share, salt=salt, jobs=jobs, console=console, keep=keep)
    suite.rows += _price_rows(prices, share, salt)
    suite.tables += _refusals([results, *late])
    illustrate(suite, found, results, prices, salted_seeds(salt, 1)[0])
    spent = sum(cell.seconds for each in (results, *late) for cell in each.found.values())
    suite.text += f"\n\nDriven in {spent / 60.0:.1f} CPU-minutes. {calibrated_by()}"
    return suite


def _learned(env_id: str) -> list[str]:
    """The training of the policies in a table."""
    cards = {name: load_policy(name).card for _, name in LEARNED[env_id] if is_policy(name)}
    return [
        f"{name}: {card.algorithm}, {card.steps:.2g} steps of {card.env_id} alone, "
        f"for the reference {card.reference}."
        for name, card in cards.items()
    ]


def _refusals(all_results: list[Results]) -> list[Table]:
    lines = [line for results in all_results for line in refusals_of(results)]
    if not lines:
        return []
    header = ("env", "manoeuvre", "controller and estimator", "what happened")
    note = (
        "The share of a cell's episodes; the rest of a failed one is charged at the highest cost."
    )
    return [Table("Cells that went wrong", header, lines, note, keyed=False)]


def _price_rows(prices: list[Price], n: int, salt: str) -> list[Row]:
    """Rows of the price of delay; the scenario has the delay."""
    return [
        Row.of(
            metric,
            each,
            suite="control",
            scenario=f"{SCENARIO}, sensors {1e3 * delay:.0f} ms late",
            estimator=price.cell.estimator,
            controller=price.cell.controller,
            n=n,
            salt=salt,
            env_version=f"{YAW} {__version__}",
        )
        for price in prices
        for metric, series in (("score", price.score), ("cost_over_informed", price.over))
        for delay, each in zip(DELAYS[: len(series)], series, strict=True)
    ]


def _note(found: list[Standing], episodes: int) -> str:
    widths = [s.overall["score"].half_width for s in found if "score" in s.overall]
    wide = f" The widest interval of a score is +-{max(widths):.3f}." if widths else ""
    return (
        f"{episodes} episodes a manoeuvre, mpc at most 64.{wide} better: probability that an "
        "episode costs less than one of two-dof on exact-kf. A decision is the estimator's step "
        "and the controller's, of one car."
    )
