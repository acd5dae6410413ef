"""The camera: what it measures as numbers, and a lane finder on pictures in its place.

`analytic` is the compiled sample of the engine, with the lane finder's measured noise. `pinhole` is
the geometry, `images` renders the road, `lane_finder` finds the lane, `pictures` reads files and
calibrates by them. Only `analytic` is loaded with the package, the others need OpenCV.
"""
