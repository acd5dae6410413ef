"""Our car in highway-env's road networks, among its vehicles; and its lane keeping as our record.

`roads` has the networks and where a place lies on their lanes, `traffic` the vehicles, `env` the
environment `sideslip/Highway-v0`, `keeping` the adapter around highway-env's `lane-keeping-v0`.
highway-env's y axis points to the right and its angles turn that way: every number is mirrored
once, where it crosses into or out of this room.
"""
