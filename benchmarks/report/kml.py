"""A drive's track for map programs: KML, its metres laid on the earth around an origin."""

from xml.sax.saxutils import escape

import numpy as np

from ...envs.record import Array
from ...envs.recordings.geodesy import to_degrees

ORIGIN = (35.9015, 139.9378)  # deg north and east: a campus of the papers' authors, our choice
_MAX_POINTS = 2000  # points

_DOCUMENT = """\
<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2">
<Document>
<name>{title}</name>
{places}
</Document>
</kml>
"""
_PLACE = """\
<Placemark>
<name>{name}</name>
<Style><LineStyle><color>{colour}</color><width>3</width></LineStyle></Style>
<LineString><tessellate>1</tessellate><coordinates>
{points}
</coordinates></LineString>
</Placemark>"""


def make_track_kml(
    title: str,
    tracks: dict[str, tuple[Array, Array]],
    colours: dict[str, str] | None = None,
    origin: tuple[float, float] = ORIGIN,
) -> str:
    """A KML document of tracks, name to (X east, Y north) in m.

    colours: name to "#RRGGBB". Raises ValueError for no track or one whose X and Y differ in
    length or are not finite.
    """
    if not tracks:
        raise ValueError("a KML document needs at least one track")
    places = []
    for name, (X, Y) in tracks.items():
        if X.shape != Y.shape or not (np.isfinite(X).all() and np.isfinite(Y).all()):
            raise ValueError(f"track {name!r}: X and Y must be finite and equally long")
        shown = np.unique(np.linspace(0, len(X) - 1, min(len(X), _MAX_POINTS)).round().astype(int))
        latitude, longitude = to_degrees(X[shown], Y[shown], origin)
        points = "\n".join(f"{e:.8f},{n:.8f}" for n, e in zip(latitude, longitude, strict=True))
        rgb = (colours or {}).get(name, "#0072B2").lstrip("#")
        bgr = "ff" + rgb[4:6] + rgb[2:4] + rgb[0:2]  # KML: alpha, blue, green, red
        places.append(_PLACE.format(name=escape(name), colour=bgr.lower(), points=points))
    return _DOCUMENT.format(title=escape(title), places="\n".join(places))
