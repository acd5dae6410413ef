"""The sensors: what each measures, its noise, and its clock and link.

`inertial` (gyro, accelerometers, wheels), `camera` and `gps` are functions from the state to a
sample; `link` is a slow sensor's clock and delays, `slow` the
table of slow sensors and of those that each id has.
"""
