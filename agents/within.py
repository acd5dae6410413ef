"""The best two inputs within limits, for a cost that is a quadratic around the free ones."""

from typing import Any

from ..envs.backend import absolute, jit


@jit
def _held(value: Any, low: Any, high: Any) -> Any:
    return min(max(value, low), high)


@jit
def best_within(
    s_uu: Any, s_uw: Any, s_ww: Any, u: Any, w: Any, most: Any, low: Any, high: Any
) -> Any:
    """(u, w) with |u| <= most and low <= w <= high nearest to the given ones.

    Nearest in du^2 s_uu + 2 du dw s_uw + dw^2 s_ww, positive definite. The given ones where they
    are within; else the least of the four edges' own minima.
    """
    if absolute(u) <= most and low <= w <= high:
        return u, w
    best_u, best_w, least = 0.0, 0.0, -1.0
    for edge in range(4):
        if edge < 2:
            a = most if edge == 0 else -most
            b = _held(w - s_uw / s_ww * (a - u), low, high)
        else:
            b = low if edge == 2 else high
            a = _held(u - s_uw / s_uu * (b - w), -most, most)
        du, dw = a - u, b - w
        cost = du * du * s_uu + 2.0 * du * dw * s_uw + dw * dw * s_ww
        if least < 0.0 or cost < least:
            best_u, best_w, least = a, b, cost
    return best_u, best_w
