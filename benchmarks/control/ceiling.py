"""The ceiling of every manoeuvre: the clairvoyant's mean cost, unless a method beats it."""

import numpy as np

from ...envs.task.failures import FAILURES
from .calibration import FILE, Entry, read_calibration
from .run import Results
from .scores import Array, Ceiling

_OF_THE_CAR = ("none", "spin", "off-road")
KNOWN = 0.1
"""A share of the way from none to the ceiling: with a larger standard error there is no score."""
_ERRORS = 3.0  # standard errors by which a method must win to become the ceiling


def carried(entry: Entry, none: Array) -> Ceiling:
    """The clairvoyant's mean cost on other seeds, of which the uncontrolled costs (n,) are known.

    By regression on the uncontrolled cost of the calibration's episodes: a few cars that hardly
    hold the road decide both means, and are not equally many among any two sets of seeds.
    """
    x = np.array([episode.costs["none"] for episode in entry.episodes])
    y = np.array([episode.cost for episode in entry.episodes])
    spread = float(((x - x.mean()) ** 2).sum())
    slope = float(((x - x.mean()) * (y - y.mean())).sum()) / spread if spread > 0.0 else 0.0
    slope = min(max(slope, 0.0), 1.0)  # nobody does worse than the uncontrolled car
    ahead = float(none.mean() - x.mean())
    rest = y - y.mean() - slope * (x - x.mean())
    share = 1.0 / len(x) + 1.0 / len(none) + (ahead**2 / spread if spread > 0.0 else 0.0)
    error = float(np.sqrt((rest**2).sum() / (len(x) - 2) * share))
    return Ceiling(max(float(y.mean()) + slope * ahead, float(y.min())), error)


def ceilings(results: Results, env_id: str) -> dict[str, Ceiling]:
    """The ceiling of each calibrated manoeuvre on the seeds of the results."""
    entries = read_calibration() if FILE.is_file() else {}
    driven = {cell.scenario for cell in results.found if cell.env_id == env_id}
    return {
        entry.scenario: carried(entry, results.of(env_id, entry.scenario, "none").costs)
        for entry in entries.values()
        if entry.env_id == env_id and entry.scenario in driven
    }


def judged(results: Results, env_id: str, tops: dict[str, Ceiling]) -> list[str]:
    """The manoeuvres with a score: control matters there, and the ceiling is known well enough."""
    return [
        name
        for name, top in tops.items()
        if results.worth_controlling(env_id, name)
        and top.error < KNOWN * (results.of(env_id, name, "none").costs.mean() - top.mean)
    ]


def calibrated_by() -> str:
    """The command of the ceilings; their file has that of each."""
    entries = read_calibration() if FILE.is_file() else {}
    if not entries:
        return "No ceiling is calibrated."
    first = next(iter(entries.values())).command
    return f"Ceilings: `{first}`, and likewise the others, by {FILE.name}."


def tops_of(results: Results, env_id: str) -> tuple[dict[str, Ceiling], list[str]]:
    """({manoeuvre: ceiling}, what to log): a method that wins by three errors is the ceiling.

    The clairvoyant is a local optimum and is calibrated on seeds of its own, so both means err.
    """
    tops, log = dict(ceilings(results, env_id)), []
    for cell, result in results.found.items():
        if cell.env_id != env_id or cell.scenario not in tops or result.error:
            continue
        top = tops[cell.scenario]
        mean = float(result.costs.mean())
        error = float(result.costs.std(ddof=1) / len(result.costs) ** 0.5)
        if top.mean - mean > _ERRORS * (top.error**2 + error**2) ** 0.5:
            tops[cell.scenario] = Ceiling(mean, error)
            log.append(
                f"{cell.label} costs {mean:.4g} on {cell.scenario}, below the clairvoyant's "
                f"{top.mean:.4g}: it is the ceiling."
            )
    return tops, log


def refusals_of(results: Results) -> list[list[str]]:
    """A line for every cell that could not be driven, or whose episodes ended by a failure that is
    not the car's (a NaN, an action that is none): env, manoeuvre, contestant, what happened."""
    lines = []
    for cell, result in results.found.items():
        where = [cell.env_id, cell.scenario, cell.label]
        if result.error:
            lines.append([*where, f"not driven: {result.error}"])
            continue
        codes = result["failure"].astype(int)
        ended = [
            f"{name} {100.0 * (codes == code).mean():.1f} %"
            for code, name in enumerate(FAILURES)
            if name not in _OF_THE_CAR and (codes == code).any()
        ]
        if ended:
            lines.append([*where, ", ".join(ended)])
    return lines
