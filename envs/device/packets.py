"""The slow sensors of an env-step on tensors: captures, packets under way, deliveries.

A row's packets lie in the order of their arrival, (arrived, captured, sensor), those under way
first and nothing behind them. An env-step puts the new ones to them, puts all in order, and takes
off the front what has arrived.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from ..backend.arrays import read
from ..backend.elementary import exp
from ..backend.on_torch import on_tensors, torch
from ..backend.primitives import select
from ..backend.random import CHANNELS, normals
from ..engine.layout import SLOW, SLOW_WIDTH, P, Z
from ..engine.packets import FAR
from ..record import CAMERA, PACKET, PACKET_WIDTH, VALUES
from ..sensors.camera import camera_sample
from ..sensors.gps import gps_sample, sky_deviation
from ..sensors.link import Link, arrivals, most_under_way
from ..ticks import NEVER
from ..vehicle.dynamics import Motion

Tensor = torch.Tensor
_LATE = 1 << 62  # the place of what never arrives


class Under(NamedTuple):
    """The slow sensors' part of the rows' state."""

    slow: Tensor  # (sensors, SLOW_WIDTH, N)
    sky: Tensor  # (N,)
    queue: Tensor  # (room, PACKET_WIDTH, N), by arrival


class Delivered(NamedTuple):
    """What arrived in an env-step."""

    packets: Tensor  # (most, PACKET_WIDTH, N)
    number: Tensor  # (N,), how many of them are there


class Window(NamedTuple):
    """The ticks of an env-step: after `first`, up to `last`, (N,) each."""

    first: Tensor
    last: Tensor
    running: Tensor  # rows that were stepped
    track: Tensor  # (n, len(Motion), N), where the car was at each tick


class Most(NamedTuple):
    """What a sensor needs room for."""

    frames: int  # captured in an env-step
    under_way: int  # packets at once
    copies: int  # of a packet


def most_of(links: Sequence[Link], n: int) -> Most:
    """What sensors with any of these links need in an env-step of n ticks."""
    return Most(
        max(-int(-n // link.period) for link in links),
        max(most_under_way(link) for link in links),
        2 if any(link.duplicate > 0.0 for link in links) else 1,
    )


class SlowSensors:
    """The slow sensors of a batch: those present, and what each one needs room for."""

    def __init__(self, most: dict[int, Most], small_angle: int, dtype: torch.dtype) -> None:
        self.most, self._small_angle = most, small_angle
        self._normals, self._arrivals, self._camera, self._gps = on_tensors(
            dtype, normals, arrivals, camera_sample, gps_sample
        )
        self._sky, self._exp, self._select = on_tensors(dtype, sky_deviation, exp, select)
        (self._read,) = on_tensors(dtype, read)

    def __call__(
        self, p: Tensor, keys: Tensor, under: Under, window: Window
    ) -> tuple[Under, Delivered]:
        """The slow sensors' state after an env-step, and what arrived in it."""
        sensors, sky = [each.unbind(0) for each in under.slow.unbind(0)], under.sky
        new: list[Tensor] = []
        for sensor, most in self.most.items():
            for _ in range(most.frames):
                sensors[sensor], sky, packets = self._capture(
                    sensor, p, keys, sensors[sensor], sky, window
                )
                new += packets
        queue = in_order(torch.cat([under.queue, torch.stack(new)]))
        arrived = queue[:, PACKET.arrived]
        due = (arrived != NEVER) & (arrived <= window.last) & window.running
        count = due.sum(0)
        slow = self._newest([list(each) for each in sensors], queue, due)
        left = taken_off(queue, count)[: len(under.queue)]
        return Under(slow, sky, left), Delivered(queue, count)

    def _capture(
        self, sensor: int, p: Tensor, keys: Tensor, slow: Any, sky: Tensor, window: Window
    ) -> tuple[Any, Tensor, list[Tensor]]:
        """The next frame of a sensor where it falls into the window: (the sensor's and the sky's
        state then, its packets, of which those that are none never arrive)."""
        pick = self._select
        frame, tick = slow[SLOW.frames], slow[SLOW.next_capture]
        active = window.running & (tick > window.first) & (tick <= window.last)
        when = tick.to(torch.int64)
        j = (when - window.first.to(torch.int64) - 1).clamp(0, len(window.track) - 1)
        width = window.track.shape[1]
        place = j.expand(1, width, -1)
        motion = Motion(*window.track.gather(0, place)[0].unbind(0))
        noise = self._read(p, P.noise)
        link = self._read(p, P.slow[sensor])
        zero, one = torch.zeros_like(tick), torch.ones_like(tick)
        if sensor == CAMERA:
            road = self._read(p, P.road)
            n = self._normals(keys[0], keys[1], when, CHANNELS.camera)
            psi, y_l = self._camera(motion, road, p[P.car.l_pre], noise, n)
            values, quality = (psi, y_l, zero, zero, zero, zero), one
        else:
            law = self._read(p, P.sky)
            n = self._normals(keys[0], keys[1], when, CHANNELS.gps)
            seen = self._normals(keys[0], keys[1], when, CHANNELS.sky)
            sky = pick(active, self._sky(sky, law, link, tick, seen), sky)
            *values, quality = self._gps(
                motion,
                p[P.car.ahead],
                p[P.car.left],
                self._exp(law.median + sky),
                law.weight,
                noise,
                n,
                self._small_angle,
            )
        block = CHANNELS.camera_link if sensor == CAMERA else CHANNELS.gps_link
        packets = []
        both = self._arrivals(link, frame, tick, keys[0], keys[1], block)
        for arrived in both[: self.most[sensor].copies]:
            due = pick(active, arrived, NEVER)
            packets.append(
                torch.stack((torch.full_like(tick, sensor), tick, due, quality, frame, *values))
            )
        following = (pick(active, frame + 1.0, frame), pick(active, tick + link.period, tick))
        return (*following, *slow[2:]), sky, packets

    def _newest(self, sensors: list[Any], queue: Tensor, due: Tensor) -> Tensor:
        """The sensors' state, as in `Under`, once the due packets were looked at in order."""
        pick = self._select
        for i in range(len(queue)):
            packet = queue[i].unbind(0)
            for sensor in self.most:
                slow = sensors[sensor]
                better = due[i] & (packet[PACKET.sensor] == sensor)
                better = better & (packet[PACKET.captured] > slow[SLOW.captured])
                told = (
                    packet[PACKET.captured],
                    *packet[PACKET.value : PACKET.value + VALUES],
                    packet[PACKET.arrived],
                )
                for k, value in enumerate(told, SLOW.captured):
                    slow[k] = pick(better, value, slow[k])
        return torch.stack([torch.stack(tuple(each)) for each in sensors])


def in_order(queue: Tensor) -> Tensor:
    """Packets (count, PACKET_WIDTH, N) by (arrived, captured, sensor), those that never arrive
    last."""
    whole = queue[:, :3].to(torch.int64)
    arrived = whole[:, PACKET.arrived]
    key = (arrived << 32) + 2 * whole[:, PACKET.captured] + whole[:, PACKET.sensor]
    key = torch.where(queue[:, PACKET.arrived] == NEVER, _LATE, key)
    place = torch.arange(len(queue), device=queue.device)[:, None]
    mine, other = key[:, None], key[None]
    ahead = (other < mine) | ((other == mine) & (place[None] < place[:, None]))
    rank = ahead.sum(1)
    order = torch.empty_like(rank).scatter_(0, rank, place.expand_as(rank))
    return queue.gather(0, order[:, None].expand(-1, PACKET_WIDTH, -1))


def taken_off(queue: Tensor, count: Tensor) -> Tensor:
    """What is left of packets in order, (room, PACKET_WIDTH, N), without the first `count` (N,)."""
    place = torch.arange(len(queue), device=queue.device)[:, None] + count
    gone = place >= len(queue)
    place = place.clamp(max=len(queue) - 1)
    left = queue.gather(0, place[:, None].expand(-1, PACKET_WIDTH, -1))
    before, after = left[:, : PACKET.arrived], left[:, PACKET.arrived + 1 :]
    arrived = left[:, PACKET.arrived].masked_fill(gone, NEVER)
    return torch.cat((before, arrived[:, None], after), 1)


def read_packed(states: Tensor, room: int) -> Under:
    """The slow sensors' part of packed states (STATE_WIDTH, N); ValueError where they hold more
    than `room` packets."""
    if bool((states[Z.under_way] > room).any()):
        raise ValueError(f"a state has more than {room} packets under way")
    slow = states[Z.slow[0].frames : Z.queue].reshape(len(Z.slow), SLOW_WIDTH, -1)
    queue = states[Z.queue : Z.sky].reshape(-1, PACKET_WIDTH, states.shape[1])[:room].clone()
    place = torch.arange(room, device=queue.device)[:, None]
    queue[:, PACKET.arrived].masked_fill_(place >= states[Z.under_way], NEVER)
    return Under(slow.clone(), states[Z.sky].clone(), in_order(queue))


def write_packed(under: Under, states: Tensor) -> None:
    """Write the slow sensors' part into packed states (STATE_WIDTH, N)."""
    count = states.shape[1]
    states[Z.slow[0].frames : Z.queue] = under.slow.reshape(-1, count)
    states[Z.queue : Z.sky] = 0.0
    flat = under.queue.reshape(-1, count)
    states[Z.queue : Z.queue + len(flat)] = flat
    states[Z.sky] = under.sky
    arrived = under.queue[:, PACKET.arrived]
    states[Z.under_way] = (arrived != NEVER).sum(0).to(states.dtype)
    states[Z.clock.next_due] = torch.where(arrived[0] == NEVER, FAR, arrived[0])
