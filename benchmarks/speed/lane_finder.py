"""What the lane finder costs and how far it errs.

`python -m sideslip.benchmarks.speed.lane_finder` prints it: on rendered pictures over the camera's
field of view, condition by condition; in drives, whose frames are compared with the analytic
camera's without noise; and its time on one core. `--write` fits a distribution to that time and
writes the file that `vision="image"` reads; `--picture FILE` draws a frame with what was found.
"""

import platform
import sys
import time
from collections.abc import Iterator
from math import radians
from pathlib import Path
from typing import Annotated, Any

import cv2
import gymnasium as gym
import numpy as np
import typer

from ...envs.backend.decorators import plain
from ...envs.backend.files import write_whole
from ...envs.documents import write_document
from ...envs.record import PACKET, Array, concatenate
from ...envs.sensors.camera import at_preview
from ...envs.sensors.camera.detector import FILE
from ...envs.sensors.camera.films import drawn
from ...envs.sensors.camera.finder import LaneFinder
from ...envs.sensors.camera.pinhole import Pinhole
from ...envs.sensors.camera.road_image import Appearance, Painter, Scene
from ...envs.vehicle.dynamics import Road
from ..harness.errors import one_line

_at_preview = plain(at_preview)

HEADING, OFFSET = 0.35, 4.0  # rad, m: the scored scenarios' field of view
LOOKS: dict[str, dict[str, float]] = {
    "clear": {},
    "noise of 10 grey levels": {"noise": 10.0},
    "noise of 20 grey levels": {"noise": 20.0},
    "blur of 2 px": {"blur": 2.0},
    "shadow takes 60 % of the light": {"shadow": 0.6},
    "30 % of the paint worn off": {"wear": 0.3},
    "60 % of the paint worn off": {"wear": 0.6},
}
PLACES: dict[str, tuple[float, dict[str, Any]]] = {
    "bends up to 1 / 50 m": (0.02, {}),
    "roll of 1 deg": (0.0, {"roll": radians(1.0)}),
    "roll of 2 deg": (0.0, {"roll": radians(2.0)}),
    "pitch of 1 deg": (0.0, {"pitch": radians(1.0)}),
    "a bend of 1 / 50 m begins beside the car": (0.0, {"road": Road(0.02, 0.0, 20.0), "s": 0.0}),
}
DRIVES = ("random-steering", "double-lane-change", "slalom", "curved-road-driver")
FINDER = LaneFinder(Pinhole())


def conditions() -> Iterator[tuple[str, Appearance, float, dict[str, Any]]]:
    """(name, appearance, most curvature in 1/m, what else of a scene) of each row of the table."""
    yield from ((name, Appearance(**look), 0.0, {}) for name, look in LOOKS.items())
    yield from ((name, Appearance(), bend, more) for name, (bend, more) in PLACES.items())


def errors(look: Appearance, bend: float, more: dict[str, Any], count: int) -> tuple[Any, ...]:
    """((found, 2) errors of psi in rad and y_l in m, the share lost, seconds of each picture)."""
    rng, painter = np.random.default_rng(1), Painter(FINDER.camera, look, FINDER.rows)
    rest, times, l_pre = [], [], FINDER.camera.preview
    for i in range(count):
        psi, y, s, kappa = rng.uniform(
            [-HEADING, -OFFSET, 0.0, -bend], [HEADING, OFFSET, 500.0, bend]
        )
        scene = Scene.bend(kappa, psi=psi, y=y, s=s)._replace(**more)
        picture = painter.picture(scene, i)
        began = time.thread_time()
        lane = FINDER.find(picture)
        times.append(time.thread_time() - began)
        if lane.quality > 0.0:
            rest.append((lane.psi - psi, lane.y_l - _at_preview(y, psi, kappa, l_pre)))
    return np.array(rest).reshape(-1, 2), 1.0 - len(rest) / count, np.array(times)


def in_drives(seeds: int) -> Array:
    """(n, 2) errors of psi in rad and y_l in m in drives without control, of lanes found."""

    def frames(scenario: Any, seed: int, **vision: Any) -> Array:
        env: Any = gym.make("sideslip/YawVision-v0", scenario=scenario, **vision)
        env.reset(seed=seed)
        records, over = [env.unwrapped.record], False
        while not over:
            _, _, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
            records.append(env.unwrapped.record)
            over = terminated or truncated
        return concatenate(records).packets_of("camera")

    rest = []
    for scenario in DRIVES:
        for seed in range(seeds):
            exact = {"base": scenario, "noise": {"camera_psi": 0.0, "camera_y": 0.0}}
            truth, seen = frames(exact, seed), frames(scenario, seed, vision="image", delay="link")
            good = seen[:, PACKET.quality] > 0.0
            rest.append((seen - truth)[good, PACKET.value : PACKET.value + 2])
    return np.concatenate(rest)


def fitted(times: Array) -> dict[str, Any]:
    """A shifted lognormal distribution of times in s."""
    least, most = float(times.min()), float(np.quantile(times, 0.999))
    logs = np.log(times - 0.9 * least)
    return {
        "shift": round(0.9 * least, 6),
        "log_mean": round(float(logs.mean()), 4),
        "log_sd": round(float(logs.std()), 4),
        "range": [round(least, 6), round(most, 6)],
    }


def picture_of(path: Path) -> None:
    """A rendered frame with what was found on it, at half the size."""
    road = Scene.bend(0.008, psi=0.06, y=0.45, s=2.0, roll=0.02)
    painter = Painter(FINDER.camera, Appearance(wear=0.3, shadow=0.5, noise=4.0))
    picture = painter.picture(road, 1)
    lane = FINDER.find(picture)
    shown = cv2.resize(drawn(picture, FINDER, lane), (768, 432), interpolation=cv2.INTER_AREA)
    write_whole(path, cv2.imencode(path.suffix, shown)[1].tobytes())


def measure(
    count: Annotated[int, typer.Option(min=1, help="Pictures of a condition.")] = 200,
    seeds: Annotated[int, typer.Option(min=1, help="Drives of a scenario.")] = 2,
    write: bool = False,
    picture: Path | None = None,
) -> None:
    """Print the tables; see the module."""
    if picture is not None and not cv2.haveImageWriter(str(picture)):
        raise ValueError(f"{picture}: a picture ends in .png or .jpg")
    cv2.setNumThreads(1)
    if picture is not None:
        picture_of(picture)
        return
    print("| condition | psi / deg | y_l / cm | worst y_l / cm | lost / % |\n|---|---|---|---|---|")
    times: list[Array] = []
    for name, look, bend, more in conditions():
        rest, lost, taken = errors(look, bend, more, count)
        times.append(taken)
        numbers = "- | - | -"  # where no lane was found
        if len(rest):
            psi, y_l = np.sqrt(np.mean(rest**2, axis=0))
            worst = np.abs(rest[:, 1]).max()
            numbers = f"{np.degrees(psi):.2f} | {100.0 * y_l:.1f} | {100.0 * worst:.1f}"
        print(f"| {name} | {numbers} | {100.0 * lost:.0f} |")
    taken = np.concatenate(times)
    driven = np.abs(in_drives(seeds))
    psi, y_l = np.quantile(driven, 0.683, axis=0)  # where a bend begins the tail is long
    root = np.sqrt(np.mean(driven**2, axis=0))
    late = np.mean(taken > 1.0 / FINDER.camera.rate)
    print(
        f"\nin drives 68 % within {np.degrees(psi):.2f} deg and {100.0 * y_l:.1f} cm, "
        f"rms {np.degrees(root[0]):.2f} deg and {100.0 * root[1]:.1f} cm\n"
        f"a picture of 1280 x 720: {1e3 * np.median(taken):.1f} ms (median), "
        f"{1e3 * np.quantile(taken, 0.99):.1f} ms (99 %), {1.0 / np.median(taken):.0f} a second; "
        f"{100.0 * late:.2f} % later than the next"
    )
    if write:
        write_document(
            FILE,
            {
                "command": f"python -m {__spec__.name} {' '.join(sys.argv[1:])}",
                "processor": _processor(),
                "pictures": len(taken),
                "seconds": fitted(taken),
                "errors": {"psi_rad": round(float(psi), 5), "y_l_m": round(float(y_l), 4)},
            },
        )


def _processor() -> str:
    """The processor's model."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(": ")[1] for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


if __name__ == "__main__":
    with one_line():
        typer.run(measure)
