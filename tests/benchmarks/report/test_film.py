"""Films and tracks: whole or not there at all, of as many frames as the drive lasts."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("pygame")
pytest.importorskip("moviepy")
from moviepy import VideoFileClip
from PIL import Image
from rich.console import Console

from sideslip.agents import make_agent
from sideslip.benchmarks.report.film import (
    ORIGIN,
    FilmDriver,
    _render_frames,
    check_film,
    make_track_kml,
    write_film,
)
from sideslip.envs.rendering.palette import GREY

SHORT: dict[str, Any] = {"scenario": {"base": "slalom", "duration": 0.4, "onset": 0.0}}


def driver(name: str = "none") -> FilmDriver:
    env = gym.make("sideslip/YawVision-v0", **SHORT)
    return FilmDriver(name, env, make_agent(name, env))


def test_a_film_lasts_as_long_as_the_drive(tmp_path: Path) -> None:
    mp4, gif = tmp_path / "a.mp4", tmp_path / "a.GIF"
    write_film(mp4, [driver()], seed=1)
    with VideoFileClip(str(mp4)) as clip:
        assert clip.size == [960, 540] and clip.fps == 50.0
        assert clip.duration == pytest.approx(0.42, abs=0.021)
    write_film(gif, [driver(), driver()], 1, Console(quiet=True))
    with Image.open(gif) as picture:
        assert picture.size == (960, 540) and picture.n_frames == 6
        assert picture.info["duration"] == 80
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.GIF", "a.mp4"]


def test_a_ghost_is_the_drive_that_it_would_be_alone() -> None:
    alone, beside = driver(), driver()
    list(_render_frames([alone], 3, 10))
    frames = list(_render_frames([driver("feedforward"), beside], 3, 10))
    assert bytes(alone.env.unwrapped._row.z) == bytes(beside.env.unwrapped._row.z)
    grey = [int(GREY[i : i + 2], 16) for i in (1, 3, 5)]
    assert (frames[-1][262:] == grey).all(2).sum() > 30  # its lines and its name


def test_nothing_is_half_written(tmp_path: Path) -> None:
    class Broken:
        def predict(self, observation: Any, state: Any = None, *_: Any, **__: Any) -> Any:
            if state == 9:
                raise RuntimeError("broken")
            return np.zeros(1, np.float32), (state or 0) + 1

    path = tmp_path / "old.mp4"
    path.write_bytes(b"older")
    with pytest.raises(RuntimeError, match="broken"):
        write_film(path, [driver()._replace(agent=Broken())])
    assert path.read_bytes() == b"older" and len(list(tmp_path.iterdir())) == 1


def test_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(__import__("sys").modules, "moviepy", None)
    with pytest.raises(ModuleNotFoundError, match=r"needs moviepy: pip install 'sideslip\[render"):
        check_film(tmp_path / "film.mp4")


NAMES = {"kml": "http://www.opengis.net/kml/2.2"}


def test_document_holds_the_track_and_hostile_names() -> None:
    x = np.linspace(0.0, 100.0, 5000)
    root = ElementTree.fromstring(make_track_kml("a < b", "one & two", x, -x).encode())
    assert [node.text for node in root.iterfind(".//kml:name", NAMES)] == ["a < b", "one & two"]
    points = (root.find(".//kml:coordinates", NAMES).text or "").split()  # type: ignore[union-attr]
    first = [float(part) for part in points[0].split(",")]
    assert first == pytest.approx([ORIGIN[1], ORIGIN[0]], abs=1e-8)
    assert 1000 < len(points) <= 2000
