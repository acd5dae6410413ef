"""The camera simulator: packets from a lane finder that reads pictures of the rendered road.

The engine captures and queues the camera's frames as usual. After a step the slow sensors are
replayed from their state before it, and each frame's packet gets the finder's values, quality and
delay before the next tick delivers anything.
"""

import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from .engine.layout import FLAGS, EpisodeArrays, P, Z
from .engine.outputs import observe, sample_slow_ticks
from .engine.window import WINDOW
from .numerics import require_extra
from .numerics.functions import PI, draw_uniforms
from .numerics.jit import as_python
from .numerics.packed import read
from .record import PACKET, PACKET_WIDTH, Array
from .sensors.slow import (
    BLOCKS,
    CAMERA,
    MAX_DELAY,
    compute_preview_offset,
    count_delay_ticks,
    load_detector,
)
from .task import REPORT
from .validation import check_mapping, check_options
from .vehicle.dynamics import Motion

if TYPE_CHECKING:
    from .sensors.camera.images import Image
    from .sensors.camera.lane_finder import Lane

_uniforms, _compute_preview_offset = as_python(draw_uniforms), as_python(compute_preview_offset)
_SLOW_STATE = slice(Z.slow[0].frames, Z.driver)  # the slow sensors and the queue of packets


class CameraSimulator:
    """Renders the pictures of one car and finds the lane in them; needs the extra `vision`.

    Args:
        delay: "fitted" or "measured", of the lane finder, or "link", the camera's own delay.
        appearance: Fields of `Appearance` that replace the defaults.
    """

    def __init__(self, delay: str, appearance: Mapping[str, object] | None) -> None:
        with require_extra("vision", "vision='image' needs {}"):
            from .sensors.camera.images import Appearance, Pinhole, RoadRenderer, RoadScene
            from .sensors.camera.lane_finder import LaneFinder
        fields = check_mapping("appearance", appearance or {})
        check_options("appearance", Appearance.__init__, fields)
        style = Appearance(**fields)
        self.delay, self._scene_class = delay, RoadScene
        self.finder = LaneFinder(Pinhole(), style.lane_width)
        self.renderer = RoadRenderer(self.finder.camera, style, self.finder.rows)
        self.picture: Image | None = None  # the newest one
        self.lane: Lane | None = None  # that was found in it
        self.metadata_flags = {"nondeterministic": True} if delay == "measured" else {}
        self.finder.find(np.zeros(self.finder.camera.size[::-1], np.uint8))  # warm

    def process_step(self, before: Array, row: EpisodeArrays, done: int) -> None:
        """Replay the slow sensors of a step, with pictures.

        Args:
            before: Packed state before the step.
            row: Arrays of the episode.
            done: Number of ticks that the step took.
        """
        z, report, n = row.z, row.report, len(row.rows)
        z[_SLOW_STATE] = before[_SLOW_STATE]
        z[Z.under_way], z[Z.clock.next_due] = before[Z.under_way], before[Z.clock.next_due]
        first, j, count = int(z[Z.clock.tick]) - done, 0, 0
        while j < done:
            frame = int(z[Z.slow[CAMERA].next_capture]) - first
            stop = min(frame, done)
            count = sample_slow_ticks(row, j, stop, count, done)
            if frame <= done:
                self.capture(row.p, z, read(row.window, WINDOW.track, stop - 1), first + stop)
            j = stop
        report[REPORT.packets] = count
        n_rows = n if row.switches[FLAGS.all_samples] else done
        observe(row, n_rows, count, (report[REPORT.beta_ref], report[REPORT.gamma_ref]))

    def capture(self, p: Array, z: Array, motion: Motion, tick: int) -> None:
        """Take a picture for the packets that were captured at a tick, if there are any.

        Args:
            p: Packed parameters.
            z: Packed state, whose queue has the packets.
            motion: `Motion` of the car at the capture.
            tick: Tick of the capture.
        """
        queue = z[Z.queue :][: int(z[Z.under_way]) * PACKET_WIDTH].reshape(-1, PACKET_WIDTH)
        is_captured = (queue[:, PACKET.sensor] == CAMERA) & (queue[:, PACKET.captured] == tick)
        if not is_captured.any():
            return
        key = int(z[Z.clock.key_low]), int(z[Z.clock.key_high])
        errors, road = read(p, P.errors), read(p, P.road)
        heading = math.remainder(motion.psi - motion.theta + errors.camera_yaw, 2.0 * PI)
        mounting = errors.camera_pitch, 1.0 / (1.0 + errors.camera_height)
        scene = self._scene_class(heading, motion.y, motion.s, motion.phi, *mounting, road)
        self.picture = self.renderer.render_picture(scene, (key[0] | key[1] << 32, tick))
        self.finder.view = read(p, P.field_of_view)
        start = time.perf_counter()
        self.lane = lane = self.finder.find(self.picture)
        elapsed = time.perf_counter() - start
        y_l = _compute_preview_offset(lane.y, lane.psi, lane.curvature, p[P.car.l_pre])
        queue[is_captured, PACKET.quality] = lane.quality
        queue[is_captured, PACKET.value], queue[is_captured, PACKET.value + 1] = lane.psi, y_l
        if self.delay != "link":
            seconds = min(elapsed, MAX_DELAY)
            if self.delay == "fitted":
                share = _uniforms(*key, tick, BLOCKS[CAMERA].link)[0]
                seconds = load_detector().compute_delay(share)
            # the first copy arrives after the delay, a duplicate as long behind it as before
            arrivals = queue[is_captured, PACKET.arrived]
            arrivals += tick + count_delay_ticks(seconds) - arrivals.min()
            queue[is_captured, PACKET.arrived] = arrivals
            z[Z.clock.next_due] = queue[:, PACKET.arrived].min()
