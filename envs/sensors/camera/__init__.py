"""The camera by pictures: a lane finder in place of the analytic camera of `sensors.slow`.

`images` has the pinhole and renders the road, `lane_finder` finds the lane, `pictures` reads files
and calibrates by them. All need OpenCV. `detector` is the file of the finder's noise and times.
"""
