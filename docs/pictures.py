"""The block diagram and the sensors' timing, docs/_static/*.svg: `python docs/pictures.py`.

`python docs/pictures.py films` drives each id for the gallery, docs/_static/film-*.gif.
"""

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from html import escape
from pathlib import Path

from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.sensors.slow import CAMERA_33_30, GPS_5_HZ

FOLDER = Path(__file__).resolve().parent / "_static"
GPS_LATENCY = 0.2  # s, the middle of what scored scenarios draw
_BLUE, _RED = "#0072B2", "#D55E00"
_STYLE = """\
text { font: 15px sans-serif; fill: #1f2328 } .b { font-weight: bold }
.s { font-size: 13px; fill: #59636e }
rect { fill: #f6f8fa; stroke: #59636e } path { stroke: #59636e; fill: none; stroke-width: 1.5 }
.tip { fill: #59636e; stroke: none }
@media (prefers-color-scheme: dark) { text { fill: #e6edf3 } .s { fill: #9198a1 }
rect { fill: #161b22; stroke: #9198a1 } path { stroke: #9198a1 } .tip { fill: #9198a1 } }"""


def _wrap(width: int, height: int, parts: list[str]) -> str:
    """Make the file of its parts."""
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>'
    return "\n".join([head, f"<style>{_STYLE}</style>", *parts, "</svg>", ""])


def _box(x: int, y: int, name: str, *lines: str) -> list[str]:
    """Draw a box of 160 by 84 with a name and lines under it."""
    parts = [f'<rect x="{x}" y="{y}" width="160" height="84" rx="6"/>']
    parts += [f'<text class="b" x="{x + 80}" y="{y + 26}" text-anchor="middle">{name}</text>']
    return parts + [
        f'<text class="s" x="{x + 80}" y="{y + 48 + 18 * i}" text-anchor="middle">'
        f"{escape(line)}</text>"
        for i, line in enumerate(lines)
    ]


def _arrow(path: str, x: int, y: int, direction: str, label: str = "", at: str = "") -> list[str]:
    """Draw a line with its tip at x, y, and a label."""
    tip = {"right": "-8 -5 v10 z", "up": "-5 8 h10 z", "down": "-5 -8 h10 z", "left": "8 -5 v10 z"}
    dx, rest = tip[direction].split(" ", 1)
    parts = [f'<path d="{path}"/>', f'<path class="tip" d="M{x} {y} l{dx} {rest}"/>']
    return parts + ([f'<text class="s" {at}>{escape(label)}</text>'] if label else [])


def draw_blocks() -> str:
    """Draw the loop of scenario, car, sensors, estimator and agent as SVG.

    Returns:
        Text of the file.
    """
    top, middle = 30, 72
    parts = [
        *_box(5, top, "Scenario", "driver, road, wind,", "what the seed draws"),
        *_box(215, top, "Car", "tyres, roll, motors,", "a step each 1 ms"),
        *_box(425, top, "Sensors", "clock, delay, noise,", "loss, offsets"),
        *_box(215, 190, "Agent", "classical or learned,", "decides each 10 ms"),
        *_box(425, 190, "Estimator", "late samples,", "angle and deviation"),
    ]
    parts += _arrow(f"M165 {middle} H208", 215, middle, "right")
    parts += _arrow(f"M375 {middle} H418", 425, middle, "right")
    parts += _arrow("M505 114 V183", 505, 190, "down", "record", 'x="513" y="156"')
    parts += _arrow(
        "M425 232 H382", 375, 232, "left", "observation", 'x="400" y="292" text-anchor="middle"'
    )
    parts += ['<path d="M400 236 V278" stroke-dasharray="2 3"/>']
    parts += _arrow(
        "M295 190 V121", 295, 114, "up", "yaw moment, steering", 'x="287" y="156" text-anchor="end"'
    )
    return _wrap(590, 300, parts)


def list_packets(sensor: SlowSensor, latency: float, until: float) -> list[tuple[float, float]]:
    """List when a slow sensor's samples are captured and arrive.

    Args:
        sensor: Sensor with its clock and delays.
        latency: Further delay (s).
        until: Time at which the list ends (s).

    Returns:
        Captured and arrived time (s) of each sample.
    """
    times = [sensor.phase + i * sensor.period for i in range(1 + int(until / sensor.period))]
    delays = sensor.delays
    return [(t, t + delays[i % len(delays)] + latency) for i, t in enumerate(times)]


def draw_timing(until: float = 0.45) -> str:
    """Draw when sensors sample and their samples arrive as SVG.

    Args:
        until: Time at which the axis ends (s).

    Returns:
        Text of the file.
    """
    left, width, rows = 130, 590, {"gyro": 34, "camera": 104, "GPS": 190, "control": 262}
    scale = (width - 12) / until

    def place(time: float) -> str:
        return f"{left + scale * time:.1f}"

    notes = {
        "gyro": "each 1 ms",
        "camera": f"each {1e3 * CAMERA_33_30.period:.0f} ms",
        "GPS": f"each {1e3 * GPS_5_HZ.period:.0f} ms",
        "control": "each 10 ms",
    }
    parts = [
        f'<text class="b" x="4" y="{y}">{name}</text><text class="s" x="4" y="{y + 18}">'
        f'{notes[name]}</text><path d="M{left} {y + 12} h{width - 12}" stroke-width="1"/>'
        for name, y in rows.items()
    ]
    for name, step, height in (("gyro", 0.001, 7), ("control", 0.01, 10)):
        ticks = " ".join(
            f"M{place(i * step)} {rows[name] + 12} v-{height}" for i in range(round(until / step))
        )
        parts.append(f'<path d="{ticks}" stroke-width="0.8"/>')
    slow: Mapping[str, tuple[SlowSensor, float, str]] = {
        "camera": (CAMERA_33_30, 0.0, _BLUE),
        "GPS": (GPS_5_HZ, GPS_LATENCY, _RED),
    }
    for name, (sensor, latency, colour) in slow.items():
        y = rows[name] + 12
        for captured, arrived in list_packets(sensor, latency, until):
            if arrived <= until:
                parts.append(
                    f'<path d="M{place(captured)} {y - 32} L{place(arrived)} {y}" '
                    f'style="stroke:{colour}"/>'
                    f'<circle cx="{place(captured)}" cy="{y - 32}" r="3" fill="{colour}"/>'
                    f'<circle cx="{place(arrived)}" cy="{y}" r="4" fill="{colour}"/>'
                )
    parts += [
        f'<text class="s" x="{place(t)}" y="298" text-anchor="middle">{1e3 * t:.0f}</text>'
        for t in (0.0, 0.1, 0.2, 0.3, 0.4)
    ]
    parts.append(
        f'<text class="s" x="{left}" y="320">time / ms. From each capture (small dot) a line leads '
        "to the arrival (large dot).</text>"
    )
    return _wrap(left + width, 328, parts)


PICTURES = {"blocks": draw_blocks, "timing": draw_timing}
FILMS = {
    "YawVision-v1": ["lqr", "joint", "--scenario", "small-car-double-lane-change"],
    "YawVisionUneven-v1": ["lqr", "joint", "--scenario", "small-car-sine-with-dwell"],
    "YawGps-v1": ["lqr", "joint", "--scenario", "small-car-random"],
    "YawFusion-v1": ["lqr", "joint", "--scenario", "road-slalom", "--vehicle", "passenger-car"],
    "AfsYawFusion-v1": ["adaptive-lqr", "joint", "--scenario", "limit-friction-split"],
    "LinearYawVision-v0": ["none", "exact-kf"],
    "LinearYawGps-v0": ["none", "exact-kf"],
    "Highway-v0": ["lqr", "exact-kf", "--seed", "16"],
    "Outside-v0": ["lqr", "exact-kf"],
}
"""Agent, estimator and further options by id."""
FILM_SECONDS, FILM_STARTS = 3.0, {"Highway-v0": 2.0}
_FILM_SIZE, _FILM_COLOURS = (560, 315), 40


def write_film(name: str) -> None:
    """Drive an id and write three seconds of its film.

    Args:
        name: Key of `FILMS`.
    """
    from PIL import Image, ImageSequence

    agent, estimator, *more = FILMS[name]
    options = ["--agent", agent, "--estimator", estimator, "--beside", "none", *more]
    with tempfile.TemporaryDirectory() as folder:
        whole = f"{folder}/whole.gif"
        command = [sys.executable, "-m", "sideslip", "run", f"sideslip/{name}", *options]
        subprocess.run([*command, "--video", whole], check=True)
        with Image.open(whole) as film:
            step = film.info["duration"]  # ms
            first = round(1e3 * FILM_STARTS.get(name, 1.0) / step)
            last = first + round(1e3 * FILM_SECONDS / step)
            frames = [
                frame.convert("RGB").resize(_FILM_SIZE).quantize(_FILM_COLOURS, dither=0)
                for i, frame in enumerate(ImageSequence.Iterator(film))
                if first <= i < last and (i - first) % 2 == 0
            ]
    file = FOLDER / f"film-{name}.gif"
    frames[0].save(
        file, save_all=True, append_images=frames[1:], duration=2 * step, loop=0, optimize=True
    )


if __name__ == "__main__":
    for name, draw in PICTURES.items():
        (FOLDER / f"{name}.svg").write_text(draw(), encoding="utf-8")
    for name in FILMS if "films" in sys.argv else ():
        write_film(name)
