"""The second layer of double-layer-gps: velocities and roll, measured by the GPS and the first."""

from ...envs.backend.decorators import copied, jit
from ...envs.backend.elementary import sincos
from ...envs.backend.primitives import maximum
from ...envs.record import PACKET
from .innovation import dilution
from .memory import COUNTERS, WINDOW, Gains, Memory, Row
from .packets import receive_sample
from .speed import finite
from .transition import BETA


@jit
def pass_on(first: Memory, second: Memory, gains: Gains, packet: Row) -> None:
    """Correct the second layer by a packet (PACKET_WIDTH,) that the first has used, as a velocity:
    v_x = V cos(beta), v_y = V sin(beta).

    double-layer-gps (8)-(9), with the first layer's sideslip angle as it was predicted for the
    captured tick. The noise along is the speed's, after the table of HDOP; the one across is that
    of the angle, (V sigma_beta)^2, and of the speed, (sigma_V sin(beta))^2.
    """
    s, captured = int(packet[PACKET.sensor]), int(packet[PACKET.captured])
    beta = first.x[BETA]
    if captured >= maximum(first.start, first.tick - WINDOW + 1) and captured < first.tick:
        beta = first.predicted[captured % WINDOW, BETA]
    sine, cosine = sincos(beta)
    V = packet[first.speed_column[s]]
    if not finite(V):
        first.counts[COUNTERS.invalid] += 1
        return
    velocity = second.sample
    copied(packet, velocity)
    velocity[PACKET.value] = V * cosine
    velocity[PACKET.value + 1] = V * sine
    factor = dilution(first, s, packet)
    along = second.r_speed * factor * factor
    second.r[s, 0] = along
    second.r[s, 1] = V * V * first.P[BETA, BETA] + along * sine * sine
    receive_sample(second, gains)
