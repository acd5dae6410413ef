"""Tracks of cones: the standards' sections, and a smooth path between the cones."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs.numerics.jit import as_python
from sideslip.envs.numerics.primitives import ARRAYS
from sideslip.envs.scenarios.road import (
    PATHS,
    TrackPath,
    compute_path_offset,
    make_path,
    make_sections,
    transform_path,
)

pytestmark = pytest.mark.plain

TRACKS = PATHS[1:]
widths = st.floats(1.0, 2.6)


def offsets(path: TrackPath, s: np.ndarray) -> np.ndarray:
    offset: np.ndarray = as_python(compute_path_offset, ARRAYS)(path, s)
    return offset


@pytest.mark.smoke
@given(widths)
def test_sections_of_iso_3888_1(w: float) -> None:
    first, side, last = make_sections("iso-3888-1", w)
    assert [each.length for each in (first, side, last)] == [15.0, 25.0, 15.0 + 15.0]
    assert (side.start - 15.0, last.start - 15.0 - 30.0 - 25.0) == (30.0, 25.0)
    assert last.start + last.length == 125.0
    assert [first.width, side.width, last.width] == [1.1 * w + 0.25, 1.2 * w + 0.25, 1.3 * w + 0.25]
    right = [each.offset - 0.5 * each.width for each in (first, side, last)]
    assert right == pytest.approx([-0.5 * first.width, 3.5 - 0.5 * first.width, right[0]])


@pytest.mark.smoke
@given(widths)
def test_sections_of_iso_3888_2(w: float) -> None:
    first, side, last = make_sections("iso-3888-2", w)
    assert [each.length for each in (first, side, last)] == [12.0, 11.0, 12.0]
    assert (side.start - 12.0, last.start - 12.0 - 13.5 - 11.0) == (13.5, 12.5)
    assert last.start + last.length == 61.0
    assert [first.width, side.width] == [1.1 * w + 0.25, w + 1.0]
    assert last.width == max(1.3 * w + 0.25, 3.0)
    # a metre between the left cones of the first lane and the right ones of the second
    gap = side.offset - 0.5 * side.width - (first.offset + 0.5 * first.width)
    assert gap == pytest.approx(1.0, rel=1e-12)
    assert last.offset - 0.5 * last.width == pytest.approx(-0.5 * first.width, rel=1e-12)


@pytest.mark.parametrize("track", TRACKS)
@given(
    w=widths, start=st.floats(-50.0, 50.0), scale=st.floats(0.2, 2.0), side=st.sampled_from([-1, 1])
)
def test_the_path_runs_through_the_centres_and_keeps_the_car_between_the_cones(
    track: str, w: float, start: float, scale: float, side: int
) -> None:
    path = transform_path(make_path(track, w), start, scale, float(side))
    for lane in make_sections(track, w, start, scale, float(side)):
        centre = offsets(path, np.array([lane.start + 0.5 * lane.length]))
        assert centre[0] == pytest.approx(lane.offset, abs=1e-12)
        off = offsets(path, lane.start + np.linspace(0.0, lane.length, 101)) - lane.offset
        assert np.abs(off).max() + 0.5 * w < 0.5 * lane.width


@pytest.mark.parametrize("track", TRACKS)
def test_the_paths_slope_is_continuous(track: str) -> None:
    path = make_path(track, 1.8)
    ends = [path.start_1, path.start_1 + path.length_1, path.start_2, path.start_2 + path.length_2]
    s, h = np.append(np.linspace(-5.0, 130.0, 4001), ends), 1e-4
    offset = [offsets(path, s + k * h) for k in (-1.0, 0.0, 1.0)]
    # a cubic of length l over a shift a bends at most by 6 a / l^2; a kink would show as h, not h^2
    bends = [(path.shift_1, path.length_1), (path.shift_2, path.length_2)]
    most = max(6.0 * abs(shift) / length**2 for shift, length in bends)
    assert np.abs(offset[0] - 2.0 * offset[1] + offset[2]).max() < 1.001 * most * h * h + 1e-14
    lanes = make_sections(track, 1.8)
    for before, after in pairwise(lanes):
        first, last = (each.start + 0.5 * each.length for each in (before, after))
        s = np.linspace(first, last, 500)
        assert np.all(np.diff(offsets(path, s)) * (after.offset - before.offset) >= 0.0)


def test_the_road_has_no_lanes_and_no_offset() -> None:
    assert make_sections("road", 1.8) == ()
    assert not offsets(make_path("road", 1.8), np.linspace(-1e3, 1e3, 99)).any()
    with pytest.raises(ValueError, match="unknown track 'iso-3888'; known: road, iso-3888-1, iso-"):
        make_sections("iso-3888", 1.8)
