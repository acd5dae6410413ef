"""KML: well-formed documents, bad tracks refused."""

from xml.etree import ElementTree

import numpy as np
import pytest

from sideslip.benchmarks.report.film import ORIGIN, make_track_kml

NAMES = {"kml": "http://www.opengis.net/kml/2.2"}


def test_document_holds_every_track_and_hostile_names() -> None:
    x = np.linspace(0.0, 100.0, 5000)
    text = make_track_kml("a < b", {"one & two": (x, x), "none": (x, -x)}, {"none": "#102030"})
    root = ElementTree.fromstring(text.encode())
    names = [node.text for node in root.iterfind(".//kml:Placemark/kml:name", NAMES)]
    assert names == ["one & two", "none"]
    colours = [node.text for node in root.iterfind(".//kml:color", NAMES)]
    assert colours[1] == "ff302010"
    points = (root.find(".//kml:coordinates", NAMES).text or "").split()  # type: ignore[union-attr]
    first = [float(part) for part in points[0].split(",")]
    assert first == pytest.approx([ORIGIN[1], ORIGIN[0]], abs=1e-8)
    assert 1000 < len(points) <= 2000


@pytest.mark.parametrize(
    "tracks",
    [{}, {"short": (np.zeros(3), np.zeros(2))}, {"lost": (np.array([0.0, np.nan]), np.zeros(2))}],
    ids=["none", "unequal", "nan"],
)
def test_bad_tracks_are_refused(tracks: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    with pytest.raises(ValueError, match="track"):
        make_track_kml("x", tracks)
