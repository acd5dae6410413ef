"""Metres on the ellipsoid, and back."""

import numpy as np
import pytest

from sideslip.envs.recordings.dialect import to_degrees, to_metres


def test_degrees_agree_with_the_earths_own_measures() -> None:
    """At the equator a degree of longitude is 111.3195 km, one of latitude 110.574 km; at 45
    degrees of latitude they are 78.847 km and 111.132 km (WGS 84)."""
    for latitude, east, north in ((0.0, 111_319.5, 110_574.3), (45.0, 78_846.8, 111_131.8)):
        up, right = to_degrees(np.array([east]), np.array([north]), (latitude, 0.0))
        assert up[0] - latitude == pytest.approx(1.0, rel=1e-5)
        assert right[0] == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("origin", [(48.0, 11.0), (-33.9, 18.4), (64.1, 179.999)])
def test_metres_are_the_inverse_of_degrees_over_the_date_line_too(
    origin: tuple[float, float],
) -> None:
    X, Y = np.random.default_rng(0).uniform(-1000.0, 1000.0, (2, 50))
    latitude, longitude = to_degrees(X, Y, origin)
    longitude = np.where(longitude > 180.0, longitude - 360.0, longitude)
    east, north = to_metres(latitude, longitude, origin)
    assert east == pytest.approx(X, abs=1e-6) and north == pytest.approx(Y, abs=1e-6)
