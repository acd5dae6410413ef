"""The measured times and errors of the lane finder, in `detector.json`."""

import functools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...ticks import TICK

_FILE = Path(__file__).with_suffix(".json")
VISIONS = ("analytic", "image")
DELAYS = ("fitted", "measured", "link")
MAX_DELAY = 0.1  # s: a measured delay counts as no more


@dataclass(frozen=True)
class Detector:
    """Time of the lane finder, shift + exp(normal), and standard deviations of its results."""

    shift: float  # s
    log_mean: float
    log_sd: float
    range: tuple[float, float]  # s, limits of what is drawn
    noise: dict[str, float]  # by the names of `Noise`

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "Detector":
        """Make a detector from the content of its file.

        Args:
            values: Parsed JSON.

        Returns:
            The detector.
        """
        times, errors = values["seconds"], values["errors"]
        noise = {"camera_psi": errors["psi_rad"], "camera_y": errors["y_l_m"]}
        shortest, longest = times["range"]
        return cls(times["shift"], times["log_mean"], times["log_sd"], (shortest, longest), noise)

    def compute_delay(self, share: float) -> float:
        """Compute the delay at a quantile of its distribution.

        Args:
            share: Quantile, in (0, 1).

        Returns:
            Delay (s), within `range`.
        """
        from statistics import NormalDist  # 2 ms, which `import sideslip` does not need

        drawn = self.shift + math.exp(NormalDist(self.log_mean, self.log_sd).inv_cdf(share))
        return min(max(drawn, self.range[0]), self.range[1])


def count_delay_ticks(seconds: float) -> int:
    """Count the whole ticks after which a result arrives.

    Args:
        seconds: Time that it takes (s).

    Returns:
        Ticks, at least one.
    """
    return max(math.ceil(seconds / TICK - 1e-9), 1)


@functools.cache
def load_detector() -> Detector:
    """Load the detector on file."""
    return Detector.from_dict(json.loads(_FILE.read_text()))
