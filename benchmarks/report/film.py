"""Films of drives, with other cars as ghosts, as MP4 or GIF; and a track for map programs (KML)."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt
from rich.console import Console

from ...agents import Agent
from ...agents.rollout import iterate_steps
from ...envs.io import atomic_file
from ...envs.numerics import require_extra
from ...envs.numerics.functions import TICK
from ...envs.record import Array
from ...envs.recordings.dialect import to_degrees
from ..harness.parallel import use_shared_bar
from ..harness.results import check_writable

Frame = npt.NDArray[np.uint8]
RATES = {".mp4": 50.0, ".gif": 12.5}  # pictures a second, by a file's ending
_COLOURS = 128  # of a GIF


class FilmDriver(NamedTuple):
    """Agent of a drive in an env, and its name in the film."""

    name: str
    env: Any  # a Gymnasium environment of this package, wrapped or not
    agent: Agent | None


def check_film(path: Path | None) -> None:
    """Check a film's ending (ValueError), folder (OSError), and the extra `render` first."""
    if path is None:
        return
    if path.suffix.lower() not in RATES:
        raise ValueError(f"a film ends in {' or '.join(RATES)}, got {str(path)!r}")
    check_writable(path)
    with require_extra("render", "a film needs {}"):
        import moviepy  # noqa: F401
        import pygame  # noqa: F401


def write_film(
    path: Path, drivers: Sequence[FilmDriver], seed: int | None = 0, console: Console | None = None
) -> None:
    """Drive an episode and write its film, whole or not at all; raises as `check_film`.

    Args:
        path: File.
        drivers: Agents; the first one's car is filmed until its episode ends, on the others' road.
        seed: Seed of the episode.
        console: Where progress is shown.
    """
    check_film(path)
    base = drivers[0].env.unwrapped
    step = base.control_period * TICK
    every = max(round(1.0 / (RATES[path.suffix.lower()] * step)), 1)
    total = base.config.base.scenario.duration / (every * step) + 1.0
    with TemporaryDirectory() as folder, use_shared_bar(console, str(path), "pictures") as bar:
        frames = bar.track(_render_frames(drivers, seed, every), total, task_id=bar.task_ids[0])
        part = Path(folder, "film").with_suffix(path.suffix.lower())
        write = _write_gif if part.suffix == ".gif" else _write_mp4
        write(part, frames, 1.0 / (every * step))
        with atomic_file(path) as file:
            file.write(part.read_bytes())


def _render_frames(drivers: Sequence[FilmDriver], seed: int | None, every: int) -> Iterator[Frame]:
    """Render steps of the first driver's episode, and its last one."""
    from ...envs.rendering.canvas import read_pixels
    from ...envs.rendering.charts import draw_picture

    bases = [driver.env.unwrapped for driver in drivers]
    first, *others = (iterate_steps(driver.env, driver.agent, seed) for driver in drivers)
    for k, step in enumerate(first):
        for other in others:
            next(other, None)  # where its episode is over it stays where it is
        main, *ghosts = [base.make_render_state() for base in bases]
        if k % every == 0 or step.terminated or step.truncated:
            named = list(zip((driver.name for driver in drivers[1:]), ghosts, strict=True))
            yield read_pixels(draw_picture(main, drivers[0].name if ghosts else "true", named))


def _write_mp4(path: Path, frames: Iterable[Frame], rate: float) -> None:
    from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter

    first = next(iterator := iter(frames))
    size, quality = first.shape[1::-1], ["-crf", "20", "-movflags", "+faststart"]
    with FFMPEG_VideoWriter(str(path), size, rate, ffmpeg_params=quality) as writer:
        for frame in itertools.chain([first], iterator):
            writer.write_frame(frame)


def _write_gif(path: Path, frames: Iterable[Frame], rate: float) -> None:
    """Write frames with one palette, without dither: what does not change costs nothing."""
    from PIL import Image

    pictures = [Image.fromarray(frame) for frame in frames]
    palette = pictures[len(pictures) // 2].quantize(_COLOURS)
    indexed = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    durations = [round(1000.0 / rate)] * len(indexed)
    durations[-1] += 1500  # ms, before it begins anew
    indexed[0].save(path, save_all=True, append_images=indexed[1:], duration=durations, loop=0)


ORIGIN = (35.9015, 139.9378)  # deg north and east: a campus of the papers' authors, our choice
_MAX_POINTS = 2000
_DOCUMENT = """\
<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2">
<Document>
<name>{title}</name>
<Placemark>
<name>{name}</name>
<Style><LineStyle><color>ffb27200</color><width>3</width></LineStyle></Style>
<LineString><tessellate>1</tessellate><coordinates>
{points}
</coordinates></LineString>
</Placemark>
</Document>
</kml>
"""


def make_track_kml(
    title: str, name: str, X: Array, Y: Array, origin: tuple[float, float] = ORIGIN
) -> str:
    """Make a KML document of a track.

    Args:
        title: Title of the document.
        name: Name of the track.
        X: Places to the east (m), shape (n,).
        Y: Places to the north (m), shape (n,).
        origin: Place of X = Y = 0 (deg north and east).
    """
    shown = np.unique(np.linspace(0, len(X) - 1, min(len(X), _MAX_POINTS)).round().astype(int))
    latitude, longitude = to_degrees(X[shown], Y[shown], origin)
    points = "\n".join(f"{e:.8f},{n:.8f}" for n, e in zip(latitude, longitude, strict=True))
    return _DOCUMENT.format(title=escape(title), name=escape(name), points=points)
