"""The sensors: what each measures, its noise, and its clock and link.

`inertial` (gyro, accelerometers, wheels) and `slow` (camera and GPS, with the sensors of each id)
compute samples, `link` is a slow sensor's clock and delays. `camera` has pictures in place of it.
"""
