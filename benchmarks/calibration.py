"""What 1 means: the clairvoyant's costs on calibration seeds, from the committed file."""

import json
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from .matrix.scores import Ceiling

FILE = "calibration.json"


@cache
def _read() -> dict[str, Any]:
    path = files(__package__).joinpath(FILE)
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


def ceilings(env_id: str) -> dict[str, Ceiling]:
    """The ceiling of each calibrated scenario of an id: the mean cost and its standard error."""
    found = {}
    for scenario, entry in _read().get(env_id, {}).items():
        costs = np.array(entry["clairvoyant"])
        found[scenario] = Ceiling(float(costs.mean()), float(costs.std(ddof=1) / len(costs) ** 0.5))
    return found
