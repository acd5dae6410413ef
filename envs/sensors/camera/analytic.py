"""The analytic camera: heading relative to the road, and lateral offset at the preview point.

The measured times and errors of the lane finder, in `detector.json`, make it one.
"""

import functools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ...numerics.functions import CHANNELS, PI, wrap
from ...numerics.jit import inline, jit
from ...numerics.primitives import Scalar, Vector, absolute, select
from ...ticks import TICK
from ...vehicle.dynamics import Motion, RoadParams, compute_curvature
from ..errors import CAMERA_HEIGHT, SensorErrors
from ..inertial import Noise
from ..link import Blocks, PacketValue, SlowKind

CAMERA_KIND = SlowKind(
    "camera",
    (PacketValue("psi", "rad", PI), PacketValue("y_l", "m", 200.0)),
    Blocks(noise=CHANNELS.camera, link=CHANNELS.camera_link, drift=CHANNELS.camera),  # no drift
    needs_quality=True,
)


class FieldOfView(NamedTuple):
    """Field of view of the camera, beyond which no lane is in the picture."""

    heading: Scalar  # rad, relative to the road, either side
    offset: Scalar  # m, of the centre of gravity from the lane's centre, either side


@jit
def compute_lane_quality(motion: Motion, field_of_view: FieldOfView) -> Scalar:
    """Compute the quality of a camera sample.

    Args:
        motion: `Motion` of the car.
        field_of_view: `FieldOfView`.

    Returns:
        1, or 0 where the lane is out of view.
    """
    is_turned = absolute(wrap(motion.psi - motion.theta)) > field_of_view.heading
    return select(is_turned | (absolute(motion.y) > field_of_view.offset), 0.0, 1.0)


@inline
def compute_preview_offset(y: Scalar, psi: Scalar, kappa: Scalar, l_pre: Scalar) -> Scalar:
    """Compute the lateral offset y_l at the preview point from the lane's centre line.

    Args:
        y: Offset of the centre of gravity (m), left positive.
        psi: Heading relative to the lane (rad).
        kappa: Curvature of the lane (1/m).
        l_pre: Preview distance (m).

    Returns:
        y_l (m), left positive.
    """
    return y + l_pre * psi - 0.5 * kappa * l_pre * l_pre  # tie-vision (4) with curvature


@jit
def sample_camera(
    motion: Motion, road: RoadParams, l_pre: Scalar, noise: Noise, n: Vector, errors: SensorErrors
) -> tuple[Scalar, Scalar]:
    """Sample the camera's heading relative to the road and its lateral offset, with noise.

    Args:
        motion: `Motion` of the car.
        road: `RoadParams`.
        l_pre: Preview distance (m).
        noise: `Noise`.
        n: Standard normal numbers, at least two.
        errors: `SensorErrors`.

    Returns:
        psi (rad) and y_l (m).
    """
    # A misaligned camera sees what is X ahead on the flat at X', 1 / X' = 1 / X - pitch / height,
    # times its height's error; lateral distances grow with X' / X, and a lane beside it seems to
    # turn. Offset and curvature are those seen at the preview point.
    tilt, growth = errors.camera_pitch * (1.0 / CAMERA_HEIGHT), 1.0 + errors.camera_height
    psi = motion.psi - motion.theta + errors.camera_yaw + tilt * motion.y
    kappa = compute_curvature(road, motion.s) / (growth + tilt * l_pre)
    y_l = compute_preview_offset(growth * motion.y, psi, kappa, l_pre)
    return wrap(psi + noise.camera_psi * n[0]), y_l + noise.camera_y * n[1]


_FILE = Path(__file__).with_name("detector.json")
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
    values: dict[str, Any] = json.loads(_FILE.read_text())
    times, errors = values["seconds"], values["errors"]
    noise = {"camera_psi": errors["psi_rad"], "camera_y": errors["y_l_m"]}
    return Detector(**times | {"range": tuple(times["range"])}, noise=noise)
