"""Metres east and north of a place on the earth, and back: the tangent plane of WGS 84."""

import math

import numpy as np

from ..record import Array

EARTH = 6_378_137.0  # m, equatorial radius
ECCENTRICITY_SQUARED = 6.694379990e-3


def compute_radii(latitude: float) -> tuple[float, float]:
    """Compute the radii of the parallel and of the meridian at a latitude.

    Args:
        latitude: Latitude (degrees north).

    Returns:
        Metres a radian (east, north).
    """
    phi = math.radians(latitude)
    w = 1.0 - ECCENTRICITY_SQUARED * math.sin(phi) ** 2
    return EARTH / math.sqrt(w) * math.cos(phi), EARTH * (1.0 - ECCENTRICITY_SQUARED) / w**1.5


def to_metres(
    latitude: Array, longitude: Array, origin: tuple[float, float]
) -> tuple[Array, Array]:
    """Convert places to metres east and north of an origin, the inverse of `to_degrees`.

    Args:
        latitude: Latitude (degrees north), shape (n,).
        longitude: Longitude (degrees east), shape (n,).
        origin: Origin (degrees north, degrees east).

    Returns:
        (east, north) (m), shape (n,) each.
    """
    east, north = compute_radii(origin[0])
    delta = (longitude - origin[1] + 180.0) % 360.0 - 180.0  # over the date line
    return east * np.radians(delta), north * np.radians(latitude - origin[0])


def to_degrees(X: Array, Y: Array, origin: tuple[float, float]) -> tuple[Array, Array]:
    """Convert metres east and north of an origin to degrees, within 0.2 m up to 1 km.

    Args:
        X: Metres east (m), shape (n,).
        Y: Metres north (m), shape (n,).
        origin: Origin (degrees north, degrees east).

    Returns:
        (latitude, longitude) (degrees), shape (n,) each.
    """
    east, north = compute_radii(origin[0])
    return origin[0] + np.degrees(Y / north), origin[1] + np.degrees(X / east)
