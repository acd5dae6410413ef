"""The camera: what it measures as numbers, and a lane finder on pictures in its place.

`analytic` is the compiled sample of the engine, and has the measured noise of the lane finder.
`pinhole` is the camera's geometry, `images` renders the road, `lane_finder` finds the lane in a
picture, `pictures` reads files, draws on them, and finds tilt, height and intrinsics from them.
Only `analytic` is loaded with the package; what works on pictures needs the extra of OpenCV.
"""
