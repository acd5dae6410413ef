"""The ceiling of every manoeuvre: the clairvoyant's mean cost, unless a method beats it."""

from ...envs import FAILURES
from ..calibrate import FILE, read_calibration
from .results import FAILURE, Results
from .scores import Ceiling

_OF_THE_CAR = ("none", "spin", "off-road")
_ERRORS = 3.0  # standard errors by which a method must win to become the ceiling


def ceilings(env_id: str) -> dict[str, Ceiling]:
    """The calibrated ceiling of each scenario of an id; none where the file is not there."""
    entries = read_calibration() if FILE.is_file() else {}
    return {
        entry.scenario: Ceiling(entry.clairvoyant, entry.clairvoyant_error)
        for entry in entries.values()
        if entry.env_id == env_id
    }


def calibrated_by() -> str:
    """The commands that made the ceilings."""
    entries = read_calibration() if FILE.is_file() else {}
    commands = " ".join(f"`{entry.command}`" for entry in entries.values())
    return f"The ceilings were made by {commands}" if commands else "No ceiling is calibrated."


def tops_of(results: Results, env_id: str) -> tuple[dict[str, Ceiling], list[str]]:
    """({manoeuvre: ceiling}, what to log): a method that wins by three errors is the ceiling.

    The clairvoyant is a local optimum and is calibrated on seeds of its own, so both means err.
    """
    tops, log = dict(ceilings(env_id)), []
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
        codes = result.numbers[:, FAILURE].astype(int)
        told = [
            f"{name} {100.0 * (codes == code).mean():.1f} %"
            for code, name in enumerate(FAILURES)
            if name not in _OF_THE_CAR and (codes == code).any()
        ]
        if told:
            lines.append([*where, ", ".join(told)])
    return lines
