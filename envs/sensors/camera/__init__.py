"""The camera by pictures: a lane finder in place of the analytic camera of `sensors.slow`.

`images` has the pinhole, reads pictures and renders the road, `lane_finder` finds the lane and how
the camera is mounted. Both need OpenCV. `detector` is the file of the finder's noise and times.

Args:
    path: Path of the file.
    camera: Camera with its mounting.
    picture: Bytes, grey (height, width) or blue, green, red (height, width, 3).
    lane_width: Distance from marking to marking (m).
"""
