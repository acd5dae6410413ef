"""The second layer of double-layer-gps: velocities and roll, told by the first what the GPS saw."""

from typing import Any

from ...envs.backend.decorators import jit
from ...envs.backend.elementary import sincos
from ...envs.backend.primitives import maximum
from ...envs.record import PACKET
from ...envs.sensors.slow import GPS
from .innovation import HDOP, dilution
from .memory import COUNTERS, WINDOW
from .packets import receive_sample
from .speed import finite

SPEED = 1  # value of a GPS packet


@jit
def pass_on(first: Any, second: Any, gains: Any, packet: Any) -> None:
    """Give the second layer a GPS packet that the first has used as a velocity: v_x = V cos(beta),
    v_y = V sin(beta).

    double-layer-gps (8)-(9), with the first layer's sideslip angle as it was predicted for the
    captured tick. The noise along is the speed's, after the table of HDOP; the one across is that
    of the angle, (V sigma_beta)^2, and of the speed, (sigma_V sin(beta))^2.
    """
    captured = int(packet[PACKET.captured])
    beta = first.x[0]
    if captured >= maximum(first.start, first.tick - WINDOW + 1) and captured < first.tick:
        beta = first.trail[captured % WINDOW, 0]
    s, c = sincos(beta)
    V = packet[PACKET.value + SPEED]
    if not finite(V):
        first.counts[COUNTERS.invalid] += 1
        return
    told = second.sample
    for i in range(len(packet)):
        told[i] = packet[i]
    told[PACKET.value] = V * c
    told[PACKET.value + 1] = V * s
    factor = dilution(first, packet[PACKET.value + HDOP])
    speed = second.r_speed * factor * factor
    second.r[GPS, 0] = speed
    second.r[GPS, 1] = V * V * first.P[0, 0] + speed * s * s
    receive_sample(second, gains)
