"""The sensors: what each measures, its noise, and its clock and link.

`inertial` (gyro, accelerometers, wheels), `camera` and `gps` are functions from the state to a
sample; `link` says when a sample arrives; `sets` which sensors an id has.
"""
