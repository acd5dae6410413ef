"""The slow sensors of an env-step on tensors, with their packets.

A car's packets are sorted by (arrived, captured, sensor). An env-step appends the new ones, sorts
all, and removes those that have arrived from the front.

Args:
    state: State of the slow sensors.
    states: Packed states of the cars, shape (STATE_WIDTH, N).
    capacity: Largest number of packets under way.
"""

from collections.abc import Sequence
from typing import NamedTuple

from ..engine.layout import SLOW_STATE, SLOW_WIDTH, P, Z
from ..engine.outputs import make_measurement_context
from ..numerics.functions import FOREVER, NEVER
from ..numerics.packed import read
from ..numerics.primitives import select
from ..numerics.torch_backend import to_torch, torch
from ..record import PACKET, PACKET_WIDTH
from ..sensors.link import compute_arrivals
from ..sensors.slow import BLOCKS, NEEDS_QUALITY, VALUES, sample_sensor
from ..vehicle.dynamics import Motion

Tensor = torch.Tensor
_NEVER_KEY = 1 << 62  # sorts packets that never arrive behind all others


class SlowState(NamedTuple):
    """The slow sensors' part of the cars' state; the cars (N) are the last axis."""

    slow: Tensor  # (sensors, SLOW_WIDTH, N)
    queue: Tensor  # (capacity, PACKET_WIDTH, N), by arrival


class Delivered(NamedTuple):
    """Packets that arrived in an env-step."""

    packets: Tensor  # (max, PACKET_WIDTH, N)
    number: Tensor  # (N,), how many of them count


class TickWindow(NamedTuple):
    """Ticks of an env-step: after `first`, up to `last`, (N,) each."""

    first: Tensor
    last: Tensor
    running: Tensor  # whether the car was stepped
    track: Tensor  # (n, len(Motion), N), motion at each tick


class PacketCapacity(NamedTuple):
    """Largest numbers of packets of a sensor."""

    frames: int  # captured in an env-step
    under_way: int  # packets at once
    copies: int  # of a packet


Capacities = dict[int, PacketCapacity]  # by the sensor's place


class SlowSensors:
    """Slow sensors of a batch.

    Args:
        capacities: Capacity of each sensor present, by index.
        small_angle: 1 for the small-angle plant, else 0.
        dtype: Type of floats.
    """

    def __init__(self, capacities: Capacities, small_angle: int, dtype: torch.dtype) -> None:
        self.capacities, self._small_angle = capacities, small_angle
        functions = sample_sensor, make_measurement_context, compute_arrivals, read, select
        self._functions = to_torch(dtype, *functions)

    def __call__(
        self, p: Tensor, keys: Tensor, state: SlowState, window: TickWindow
    ) -> tuple[SlowState, Delivered]:
        """Compute the slow sensors' state after an env-step, and the packets that arrived in it."""
        sensors = [list(sensor_state.unbind(0)) for sensor_state in state.slow.unbind(0)]
        new_packets: list[Tensor] = []
        for sensor, capacity in self.capacities.items():
            for _ in range(capacity.frames):
                sensors[sensor], packets = self._capture(sensor, p, keys, sensors[sensor], window)
                new_packets += packets
        queue = _sort_packets(torch.cat([state.queue, torch.stack(new_packets)]))
        arrived = queue[:, PACKET.arrived]
        due = (arrived != NEVER) & (arrived <= window.last) & window.running
        count = due.sum(0)
        slow = self._update_newest(sensors, queue, due)
        remaining = _remove_first(queue, count)[: len(state.queue)]
        return SlowState(slow, remaining), Delivered(queue, count)

    def _capture(
        self, sensor: int, p: Tensor, keys: Tensor, slow: Sequence[Tensor], window: TickWindow
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Capture a sensor's next frame if it is in the window: (sensor's state, its packets)."""
        functions, pick = self._functions, self._functions.select
        frame, tick = slow[SLOW_STATE.frames], slow[SLOW_STATE.next_capture]
        active = window.running & (tick > window.first) & (tick <= window.last)
        when = tick.to(torch.int64)
        j = (when - window.first.to(torch.int64) - 1).clamp(0, len(window.track) - 1)
        tick_index = j.expand(1, window.track.shape[1], -1)
        motion = Motion(*window.track.gather(0, tick_index)[0].unbind(0))
        link, before = functions.read(p, P.slow[sensor]), slow[SLOW_STATE.drift]
        context = functions.make_measurement_context(p, motion, self._small_angle, keys, tick)
        values, quality, drift = functions.sample_sensor(sensor, context, link, before)
        fields = [
            number if isinstance(number, Tensor) else torch.full_like(tick, number)
            for number in (quality, frame, *values)
        ]
        packets, block = [], BLOCKS[sensor].link
        arrivals = functions.compute_arrivals(link, frame, tick, keys[0], keys[1], block)
        stamp = tick + link.stamp  # nothing arrives before it
        for arrived in arrivals[: self.capacities[sensor].copies]:
            arrived = pick(arrived == NEVER, NEVER, torch.maximum(arrived, stamp))
            arrival_tick = pick(active, arrived, NEVER)  # outside the window it never arrives
            head = torch.full_like(tick, sensor), stamp, arrival_tick
            packets.append(torch.stack((*head, *fields)))
        next_state = list(slow)
        next_state[SLOW_STATE.frames] = pick(active, frame + 1.0, frame)
        next_state[SLOW_STATE.next_capture] = pick(active, tick + link.period, tick)
        next_state[SLOW_STATE.drift] = pick(active, drift, before)
        return next_state, packets

    def _update_newest(self, sensors: list[list[Tensor]], queue: Tensor, due: Tensor) -> Tensor:
        """Update the sensors' newest samples by the due packets; return their `SlowState.slow`."""
        for i in range(len(queue)):
            packet = queue[i].unbind(0)
            for sensor in self.capacities:
                slow = sensors[sensor]
                is_newer = due[i] & (packet[PACKET.sensor] == sensor)
                is_newer = is_newer & (packet[PACKET.captured] > slow[SLOW_STATE.captured])
                if NEEDS_QUALITY[sensor]:
                    is_newer = is_newer & (packet[PACKET.quality] > 0.0)
                values = packet[PACKET.value : PACKET.value + VALUES]
                newest = (packet[PACKET.captured], *values, packet[PACKET.arrived])
                for k, value in enumerate(newest, SLOW_STATE.captured):
                    slow[k] = self._functions.select(is_newer, value, slow[k])
        return torch.stack([torch.stack(sensor_state) for sensor_state in sensors])


def _sort_packets(queue: Tensor) -> Tensor:
    """Sort packets (count, PACKET_WIDTH, N); those that never arrive come last."""
    stamps = queue[:, :3].to(torch.int64)
    arrived = stamps[:, PACKET.arrived]
    key = (arrived << 32) + len(Z.slow) * stamps[:, PACKET.captured] + stamps[:, PACKET.sensor]
    key = torch.where(queue[:, PACKET.arrived] == NEVER, _NEVER_KEY, key)
    order = key.argsort(stable=True, dim=0)
    return queue.gather(0, order[:, None].expand(-1, PACKET_WIDTH, -1))


def _remove_first(queue: Tensor, count: Tensor) -> Tensor:
    """Remove the first `count` (N,) of sorted packets (capacity, PACKET_WIDTH, N)."""
    place = torch.arange(len(queue), device=queue.device)[:, None] + count
    is_gone = place >= len(queue)
    place = place.clamp(max=len(queue) - 1)
    remaining = queue.gather(0, place[:, None].expand(-1, PACKET_WIDTH, -1))
    remaining[:, PACKET.arrived].masked_fill_(is_gone, NEVER)
    return remaining


def read_packed(states: Tensor, capacity: int) -> SlowState:
    """Read the slow sensors' part of packed states."""
    if bool((states[Z.under_way] > capacity).any()):
        raise ValueError(f"a state has more than {capacity} packets under way")
    slow = states[Z.slow[0].frames : Z.queue].reshape(len(Z.slow), SLOW_WIDTH, -1)
    queue = states[Z.queue : Z.driver].reshape(-1, PACKET_WIDTH, states.shape[1])[:capacity].clone()
    place = torch.arange(capacity, device=queue.device)[:, None]
    queue[:, PACKET.arrived].masked_fill_(place >= states[Z.under_way], NEVER)
    return SlowState(slow.clone(), _sort_packets(queue))


def write_packed(state: SlowState, states: Tensor) -> None:
    """Write the slow sensors' part into packed states."""
    count = states.shape[1]
    states[Z.slow[0].frames : Z.queue] = state.slow.reshape(-1, count)
    states[Z.queue : Z.driver] = 0.0
    flat = state.queue.reshape(-1, count)
    states[Z.queue : Z.queue + len(flat)] = flat
    arrived = state.queue[:, PACKET.arrived]
    states[Z.under_way] = (arrived != NEVER).sum(0).to(states.dtype)
    states[Z.clock.next_due] = torch.where(arrived[0] == NEVER, FOREVER, arrived[0])
