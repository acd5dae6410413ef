"""The analytic camera: heading relative to the road, and lateral offset at the preview point."""

from typing import NamedTuple

from ...numerics.functions import CHANNELS, PI, wrap
from ...numerics.jit import inline, jit
from ...numerics.primitives import Scalar, Vector, absolute, select
from ...vehicle.dynamics import Motion, RoadParams, compute_curvature
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
def compute_lane_offset(motion: Motion, road: RoadParams, l_pre: Scalar) -> Scalar:
    """Compute the lateral offset at the preview point of a car on a road.

    Args:
        motion: `Motion` of the car.
        road: `RoadParams`.
        l_pre: Preview distance (m).

    Returns:
        y_l (m), left positive.
    """
    return compute_preview_offset(
        motion.y, motion.psi - motion.theta, compute_curvature(road, motion.s), l_pre
    )


@jit
def sample_camera(
    motion: Motion, road: RoadParams, l_pre: Scalar, noise: Noise, n: Vector
) -> tuple[Scalar, Scalar]:
    """Sample the camera's heading relative to the road and its lateral offset, with noise.

    Args:
        motion: `Motion` of the car.
        road: `RoadParams`.
        l_pre: Preview distance (m).
        noise: `Noise`.
        n: Standard normal numbers, at least two.

    Returns:
        psi (rad) and y_l (m).
    """
    psi, y_l = motion.psi - motion.theta, compute_lane_offset(motion, road, l_pre)
    return wrap(psi + noise.camera_psi * n[0]), y_l + noise.camera_y * n[1]
