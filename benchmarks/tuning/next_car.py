"""What each part of `joint` is worth on cars that its levels were not found on.

`python -m sideslip.benchmarks.tuning.next_car --drives 250 --out docs/next_car.json` runs filters
with one part less over drives of `levels.draw_drive` with other seeds.
"""

import json
import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from ..harness.parallel import run_cases
from ..harness.results import write_text
from ..harness.stats import average, compute_honesty
from .levels import draw_drive, run_filter

FIRST_SEED = 100_000  # no drive of the search
_NO_TYRES = {"front_tyres_sd": 0.0, "rear_tyres_sd": 0.0, "inverse_friction_sd": 0.0}
PARTS: dict[str, Mapping[str, object]] = {
    "joint": {},
    "without the accelerometer": {"fast": ("gyro",)},
    "without a time of the moment's own": {"moment_time": 0.0},
    "without noise found while driving": {"noise_time": 0.0},
    "without heavy tails": {"robust": 0.0},
    "without the gyro's bias": {"bias_sd": 0.0},
    "without the accelerometer's bias": {"accel_bias_sd": 0.0},
    "without the accelerometer's scale": {"accel_scale_sd": 0.0},
    "without the steering's offset": {"steer_offset_sd": 0.0},
    "without the road's bank": {"bank_sd": 0.0},
    "without the camera's yaw": {"camera_yaw_sd": 0.0},
    "without the map's heading": {"map_heading_sd": 0.0},
    "without friction": {"inverse_friction_sd": 0.0},
    "without tyres": _NO_TYRES | {"accel_scale_sd": 0.0},
}  # filters by name, as options over the defaults


def _measure(seed: int, names: tuple[str, ...]) -> list[tuple[float, ...]]:
    """Judge all filters on a drive: RMS error (rad), NEES, coverage, log score of each."""
    episode, judged = draw_drive(seed), list[tuple[float, ...]]()
    for name in names:
        error, deviation = run_filter(episode, PARTS[name])
        if len(error):
            judged.append((float(np.sqrt(np.mean(error**2))), *compute_honesty(error, deviation)))
    return judged


def main(
    drives: Annotated[int, typer.Option(min=2, help="Drives, the same for all.")] = 250,
    out: Annotated[Path | None, typer.Option(help="JSON for the table.")] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes.")] = None,
) -> None:
    """Compare `joint` with itself, one part less at a time."""
    console, names = Console(), tuple(PARTS)
    seeds = range(FIRST_SEED, FIRST_SEED + drives)
    judged = run_cases(partial(_measure, names=names), seeds, "the next car", jobs, console)
    numbers = np.array([row for row in judged if row])  # (drives, filters, 4)
    rows = []
    for i, name in enumerate(names):
        rmse, nees, held, score = numbers[:, i].T
        lead = average(numbers[:, 0, 3] - score)
        row = {
            "filter": name,
            "rms / deg": math.degrees(float(np.sqrt(np.mean(rmse**2)))),
            "median NEES": float(np.median(nees)),
            "in 95 % / %": 100.0 * float(np.mean(held)),
            "log score lost": [float(lead.value), float(lead.low), float(lead.high)],
        }
        rows.append(row)
        console.print(row, highlight=False)
    if out is not None:
        write_text(out, json.dumps({"n": len(numbers), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    from sideslip.benchmarks.tuning import next_car  # by its name: workers import it

    typer.run(next_car.main)
