"""The sensors: what each measures, its noise, and its clock and link.

`inertial` (gyro, accelerometers, wheels) and `camera` compute samples, `link` is a slow sensor's
clock and delays, `slow` the table of slow sensors and of each id's. `errors` are of world v1.
"""
