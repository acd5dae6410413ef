"""Our car in highway-env's road networks, among its vehicles; and its lane keeping as our record.

`traffic` has the networks and the vehicles, `env` the environments. highway-env's y axis points to
the right: every number is mirrored once, where it crosses into or out of this room.

Args:
    motion: `Motion` of our car.
"""
