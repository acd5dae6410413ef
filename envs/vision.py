"""A camera that takes pictures: packets from what a lane finder sees of the rendered road.

The engine captures and queues the camera's frames as ever. After a step its slow sensors are gone
through once more from where they stood before it, and every frame's packet takes the finder's
values, quality and delay before the next tick delivers anything.
"""

import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.envs.registration import EnvSpec

from .arguments import mapping_of, unknown_names
from .backend.arrays import read
from .backend.decorators import plain
from .backend.elementary import PI
from .backend.extras import extra
from .backend.random import uniforms
from .engine.arrays import Row
from .engine.layout import P, Z
from .engine.step import sense_ticks, sum_up
from .engine.window import WINDOW
from .record import PACKET, PACKET_WIDTH, Array
from .sensors.camera.analytic import at_preview
from .sensors.camera.detector import SLOWEST, detector, ticks_taken
from .sensors.slow import BLOCKS, CAMERA
from .vehicle.dynamics import Motion

if TYPE_CHECKING:
    from .sensors.camera.finder import Lane
    from .sensors.camera.road_image import Image

_uniforms, _at_preview = plain(uniforms), plain(at_preview)
_SLOW = slice(Z.slow[0].frames, Z.driver)  # the slow sensors and the queue of packets


class Eye:
    """Takes the pictures of one car and finds the lane in them; needs the extra `vision`.

    `picture` and `lane` are the newest ones. delay, appearance: as of `Seeing`.
    """

    def __init__(self, delay: str, appearance: Mapping[str, Any] | None) -> None:
        with extra("vision", "vision='image' needs {}"):
            from .sensors.camera.finder import LaneFinder
            from .sensors.camera.pinhole import Pinhole
            from .sensors.camera.road_image import Appearance, Painter, Scene
        fields = mapping_of("appearance", appearance or {})
        if unknown := [name for name in fields if name not in Appearance.__dataclass_fields__]:
            known = Appearance.__dataclass_fields__
            raise TypeError(f"appearance: {unknown_names('field', unknown, known)}")
        look = Appearance(**fields)
        self.delay, self._scene = delay, Scene
        self.finder = LaneFinder(Pinhole(), look.lane_width)
        self.painter = Painter(self.finder.camera, look, self.finder.rows)
        self.picture: Image | None = None
        self.lane: Lane | None = None
        self.marks = {"nondeterministic": True} if delay == "measured" else {}
        self.finder.find(np.zeros(self.finder.camera.size[::-1], np.uint8))  # warm

    def look(self, before: Any, row: Row, done: int, bounds: Array, window: Array) -> None:
        """Go through the slow sensors of a step of `done` ticks once more, with pictures.

        before: the state ahead of the step. The others are as of `conclude`.
        """
        z = row.z
        z[_SLOW] = before[_SLOW]
        z[Z.under_way], z[Z.clock.next_due] = before[Z.under_way], before[Z.clock.next_due]
        first, j, count = int(z[Z.clock.tick]) - done, 0, 0
        while j < done:
            frame = int(z[Z.slow[CAMERA].next_capture]) - first
            stop = min(frame, done)
            count = sense_ticks(row, j, stop, count, done, window)
            if frame <= done:
                self.take(row.p, z, read(window, WINDOW.track, stop - 1), first + stop)
            j = stop
        sum_up(row, len(row.rows), done, count, bounds)

    def take(self, p: Array, z: Array, motion: Motion, tick: int) -> None:
        """Take a picture for the packets that were captured at a tick, if there are any.

        p, z: the packed parameters and state, whose queue has the packets.
        """
        queue = z[Z.queue :][: int(z[Z.under_way]) * PACKET_WIDTH].reshape(-1, PACKET_WIDTH)
        mine = (queue[:, PACKET.sensor] == CAMERA) & (queue[:, PACKET.captured] == tick)
        if not mine.any():
            return
        key = int(z[Z.clock.key_low]), int(z[Z.clock.key_high])
        turned = math.remainder(motion.psi - motion.theta, 2.0 * PI)
        scene = self._scene(turned, motion.y, motion.s, motion.phi, 0.0, read(p, P.road))
        self.picture = self.painter.picture(scene, (key[0] | key[1] << 32, tick))
        self.finder.view = read(p, P.sight)
        began = time.perf_counter()
        self.lane = lane = self.finder.find(self.picture)
        took = time.perf_counter() - began
        y_l = _at_preview(lane.y, lane.psi, lane.curvature, p[P.car.l_pre])
        queue[mine, PACKET.quality] = lane.quality
        queue[mine, PACKET.value], queue[mine, PACKET.value + 1] = lane.psi, y_l
        if self.delay != "link":
            late = _uniforms(*key, tick, BLOCKS[CAMERA].link)[0]
            seconds = min(took, SLOWEST) if self.delay == "measured" else detector().delay(late)
            arrived = tick + ticks_taken(seconds)
            queue[mine, PACKET.arrived] += arrived - queue[mine, PACKET.arrived].min()
            z[Z.clock.next_due] = queue[:, PACKET.arrived].min()


class Seeing:
    """An environment whose camera may take pictures.

    vision: "analytic", the camera's numbers with noise, or "image": a picture of the road is
    rendered at every frame and a lane finder reads it; `env.unwrapped.eye` has the newest. delay,
    of pictures: "fitted" (default), drawn from the finder's times on file; "measured", what the
    clock says, so that the environment is not deterministic, which `spec`, `metadata` and `info`
    state; or "link", the camera's own. appearance: fields of `Appearance`, which replace the clear
    road's.
    """

    eye: Eye | None = None
    metadata: dict[str, Any]
    _params: Array
    _state: Array
    _spec: EnvSpec | None = None

    def _see_in(self, vision: str, delay: str | None, appearance: Any) -> None:
        if vision == "image":
            self.eye = Eye(delay or "fitted", appearance)
            self.metadata = {**self.metadata, **self.eye.marks}
        elif appearance is not None:
            raise ValueError("appearance is of pictures: vision='image'")

    def _begin(self) -> None:
        """What else begins with an episode whose tick 0 is packed."""
        if self.eye is not None:
            self.eye.take(self._params, self._state, read(self._state, Z.motion), 0)

    @property
    def spec(self) -> EnvSpec | None:
        """What `gym.make` builds this env from."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and self.eye is not None and self.eye.marks:
            spec.nondeterministic = True
        self._spec = spec
