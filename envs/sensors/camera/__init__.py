"""The camera: what it measures as numbers, and a lane finder on pictures in its place.

`analytic` is the compiled sample of the engine. `pinhole` is the camera's geometry, `images`
renders the road, `lane_finder` finds the lane in a picture, `calibration` finds tilt, height and
intrinsics, `films` reads files, `detector` has the measured noise of the lane finder. Only
`analytic` is loaded with the package; what works on pictures needs the extra of OpenCV.
"""

from .analytic import (
    CAMERA_KIND,
    FieldOfView,
    compute_lane_offset,
    compute_lane_quality,
    compute_preview_offset,
    sample_camera,
)

__all__ = [
    "CAMERA_KIND",
    "FieldOfView",
    "compute_lane_offset",
    "compute_lane_quality",
    "compute_preview_offset",
    "sample_camera",
]
