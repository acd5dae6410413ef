"""The camera: heading relative to the road and lateral offset at the preview point."""

from typing import Any, NamedTuple

from ...backend.decorators import inlined, jit
from ...backend.elementary import PI, wrap
from ...backend.primitives import absolute, select
from ...backend.random import CHANNELS
from ...vehicle.dynamics import curvature_at
from ..kind import Blocks, SlowKind, Value

CAMERA_KIND = SlowKind(
    "camera",
    (Value("psi", "rad", PI), Value("y_l", "m", 200.0)),
    Blocks(noise=CHANNELS.camera, link=CHANNELS.camera_link, drift=CHANNELS.camera),  # no drift
    sees=True,
)


class View(NamedTuple):
    """The camera's field of view: beyond it there is no lane in the picture."""

    heading: Any  # rad, relative to the road, either side
    offset: Any  # m, of the centre of gravity from the lane's centre, either side


@jit
def lane_in_view(motion: Any, sight: Any) -> Any:
    """The quality of a picture: 1, or 0 where the lane is out of view."""
    turned = absolute(wrap(motion.psi - motion.theta)) > sight.heading
    return select(turned | (absolute(motion.y) > sight.offset), 0.0, 1.0)


@inlined
def at_preview(y: Any, psi: Any, kappa: Any, l_pre: Any) -> Any:
    """Lateral offset y_l in m at the preview point, positive to the left of the lane's centre line.

    y: m, of the centre of gravity. psi: rad, relative to the lane. kappa: 1/m. l_pre: m.
    """
    return y + l_pre * psi - 0.5 * kappa * l_pre * l_pre  # tie-vision (4) with curvature


@jit
def lane_offset(motion: Any, road: Any, l_pre: Any) -> Any:
    """`at_preview` of a Motion on a road."""
    return at_preview(motion.y, motion.psi - motion.theta, curvature_at(road, motion.s), l_pre)


@jit
def camera_sample(motion: Any, road: Any, l_pre: Any, noise: Any, n: Any) -> Any:
    """(psi, y_l): heading relative to the road, and `lane_offset`."""
    psi, y_l = motion.psi - motion.theta, lane_offset(motion, road, l_pre)
    return wrap(psi + noise.camera_psi * n[0]), y_l + noise.camera_y * n[1]
