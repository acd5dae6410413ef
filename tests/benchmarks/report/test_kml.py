"""KML: metres on the ellipsoid, well-formed documents, bad tracks refused."""

from xml.etree import ElementTree

import numpy as np
import pytest

from sideslip.benchmarks.report.kml import ORIGIN, degrees, track_kml

NAMES = {"kml": "http://www.opengis.net/kml/2.2"}


def test_degrees_agree_with_the_earths_own_measures() -> None:
    """At the equator a degree of longitude is 111.3195 km, one of latitude 110.574 km; at 45
    degrees of latitude they are 78.847 km and 111.132 km (WGS 84)."""
    for latitude, east, north in ((0.0, 111_319.5, 110_574.3), (45.0, 78_846.8, 111_131.8)):
        up, right = degrees(np.array([east]), np.array([north]), (latitude, 0.0))
        assert up[0] - latitude == pytest.approx(1.0, rel=1e-5)
        assert right[0] == pytest.approx(1.0, rel=1e-5)


def test_document_holds_every_track_and_hostile_names() -> None:
    x = np.linspace(0.0, 100.0, 5000)
    text = track_kml("a < b", {"one & two": (x, x), "none": (x, -x)}, {"none": "#102030"})
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
    [
        {},
        {"short": (np.zeros(3), np.zeros(2))},
        {"lost": (np.array([0.0, np.nan]), np.zeros(2))},
    ],
    ids=["none", "unequal", "nan"],
)
def test_bad_tracks_are_refused(tracks: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    with pytest.raises(ValueError, match="track"):
        track_kml("x", tracks)
