"""The sensors: what each measures, its noise, and its clock and link.

`inertial` (gyro, accelerometers, wheels) and `camera` are functions from the state to a sample;
`link` is a slow sensor's clock and delays, `slow` the table of slow sensors, the GPS among them,
and of those that each id has. `errors` are those of world v1.
"""
