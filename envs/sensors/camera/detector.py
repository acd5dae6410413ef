"""The lane finder as it was measured, in `detector.json`: its time and its errors in drives."""

import functools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...ticks import TICK

FILE = Path(__file__).with_suffix(".json")
VISIONS = ("analytic", "image")
DELAYS = ("fitted", "measured", "link")
MAX_DELAY = 0.1  # s: a measured delay counts as no more


@dataclass(frozen=True)
class Detector:
    """The time from a picture to its lane, shift + exp(normal), and the standard deviations of
    what is found."""

    shift: float  # s
    log_mean: float
    log_sd: float
    range: tuple[float, float]  # s, the least and the most that is drawn
    noise: dict[str, float]  # by the names of `Noise`

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "Detector":
        """From what the file holds."""
        times, errors = values["seconds"], values["errors"]
        noise = {"camera_psi": errors["psi_rad"], "camera_y": errors["y_l_m"]}
        shortest, longest = times["range"]
        return cls(times["shift"], times["log_mean"], times["log_sd"], (shortest, longest), noise)

    def compute_delay(self, share: float) -> float:
        """Seconds, at a share in (0, 1) of the distribution."""
        from statistics import NormalDist  # 2 ms that every import of the package would pay

        drawn = self.shift + math.exp(NormalDist(self.log_mean, self.log_sd).inv_cdf(share))
        return min(max(drawn, self.range[0]), self.range[1])


def count_delay_ticks(seconds: float) -> int:
    """Whole ticks after which what took so long arrives, one at least."""
    return max(math.ceil(seconds / TICK - 1e-9), 1)


@functools.cache
def load_detector() -> Detector:
    """The one on file."""
    return Detector.from_dict(json.loads(FILE.read_text()))
