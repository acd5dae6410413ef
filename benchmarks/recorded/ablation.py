"""Question: what does each part of `joint-robust` save on a recorded drive of a car not known?

`python -m sideslip.benchmarks.recorded.ablation LOG --vehicle ferrari-250lm-nominal`
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from ... import __version__
from ...envs.record import Log
from ...envs.recordings.parts import read_parts
from ...envs.vehicle.vehicle import Vehicle
from ...envs.vehicle.vehicles import vehicle_from
from ..harness.results import Row, Suite, Table
from ..harness.stats import Estimate
from .run import OWN_NOISE, Settings, drives_of, run_estimators
from .suite import CORNERS, DEGREES

NEVER = 1e-6
WITHOUT: Mapping[str, Mapping[str, Any]] = {
    "complete": {},
    "without accelerometer": {"accel_y_noise": 1e3, "accel_time": 0.0},
    "without friction": {"inverse_friction_sd": 0.0},
    "without scale": {"accel_scale_sd": 0.0},
    "without a check of steering": {"steer_rate": 0.0},
    "without stiffness": {
        **dict.fromkeys(("front_tyres_sd", "rear_tyres_sd"), NEVER),
        **dict.fromkeys(("q_front_tyres", "q_rear_tyres"), 0.0),
    },
    "without disturbances": {
        **dict.fromkeys(("force_sd", "moment_sd"), 1.0),
        **dict.fromkeys(("force_share", "moment_share", "model_error"), 0.0),
    },
    "without biases": dict.fromkeys(("bias_sd", "accel_bias_sd"), NEVER),
}
"""Options of `joint-robust`: a part that is not to be has a deviation of nothing, or of all."""
LATE = {"delay": 0.2, "gyro_bias_degps": 0.2}  # s, deg/s


def ablation(log: Log, vehicle: Vehicle, **settings: Any) -> Suite:
    """Errors of `joint-robust` without each of its parts, with the vehicle and its four corners.

    settings: of `replay`, over a course that is 0.2 s late and a gyro that is off by 0.2 deg/s.
    Rows: rmse (rad), the median, least and most over the noises. Raises what `corners` does.
    """
    if "beta" not in log.truth:
        raise ValueError(f"{log.name}: parts are scored against sideslip truth; there is none")
    settings = LATE | settings
    drives = drives_of(log, Settings(**settings))
    cells, suite = [], Suite("replay", f"A recorded drive: {log.name}", "")
    for label, options in WITHOUT.items():
        how = Settings(**settings, estimators=[OWN_NOISE], options={OWN_NOISE: options})
        errors = []
        for factors in ((1.0, 1.0), *CORNERS):
            found = run_estimators(drives, vehicle.scaled(*factors), how)
            errors.append(found.rmse(OWN_NOISE))
            place = f"{vehicle.name}, front x {factors[0]}, rear x {factors[1]}"
            suite.rows.append(
                Row.of(
                    "rmse",
                    Estimate(*errors[-1]),
                    suite="replay",
                    scenario=f"{log.name}: {place}",
                    estimator=f"{OWN_NOISE}, {label}",
                    n=len(drives),
                    salt=f"seed {how.seed}",
                    env_version=f"replay {__version__}",
                )
            )
        cells.append([label, *(f"{DEGREES * median:.2f}" for median, _, _ in errors)])
    places = ("nominal", *(f"{front} / {rear}" for front, rear in CORNERS))
    note = f"Columns: front / rear stiffness; medians over {len(drives)} noises of the course."
    title = f"{log.name}, {vehicle.name}: what each part saves, RMSE / deg"
    suite.tables = [Table(title, (OWN_NOISE, *places), cells, note, keyed=False)]
    return suite


def main(
    log: Annotated[Path, typer.Argument(help="A recorded drive with sideslip truth.")],
    vehicle: Annotated[str, typer.Option(help="A name or a file.")] = "ferrari-250lm-nominal",
    seeds: Annotated[int, typer.Option(help="Noises of the emulated course.")] = 5,
) -> None:
    """Print the table for the longest part of a log, as Markdown."""
    parts, _ = read_parts(log, {})
    longest = max(parts, key=lambda part: len(part.record.fast))
    (table,) = ablation(longest, vehicle_from(vehicle), seeds=seeds).tables
    for cells in (table.header, ["---"] * len(table.header), *table.cells):
        print(f"| {' | '.join(cells)} |")
    print(f"\n{table.title}. {table.note}")


if __name__ == "__main__":
    typer.run(main)
