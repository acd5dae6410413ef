"""Controllers, one or several alike in a file, around the compiled law of `base.Controller`.

Args:
    state: Memory, shape (N, memory).
    action: Action that the env gets, shape (N, width).
    speed: Speed (m/s).
"""
