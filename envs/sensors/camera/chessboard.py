"""A camera's intrinsics from photographs of a chessboard. Needs the extra `vision`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .pinhole import Pinhole

MIN_BOARDS = 3  # boards


def calibrate_camera(
    paths: Sequence[Path], corners: tuple[int, int] = (9, 6)
) -> tuple[Pinhole, float]:
    """Compute a camera's intrinsics from photographs of a chessboard; tilt and height are defaults.

    Args:
        paths: Files of the photographs; those without a board are skipped.
        corners: Inner corners of the board along its two sides.

    Returns:
        The camera, and the root mean square error of the corners (px).

    Raises:
        ValueError: If fewer than three show a board, or photographs have different sizes.
    """
    board = np.zeros((corners[0] * corners[1], 3), np.float32)
    board[:, :2] = np.mgrid[: corners[0], : corners[1]].T.reshape(-1, 2)
    corner_sets: list[Any] = []
    sizes: dict[tuple[int, int], int] = {}
    for path in paths:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            continue
        is_found, places = cv2.findChessboardCorners(grey, corners)
        if is_found:
            stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
            corner_sets.append(cv2.cornerSubPix(grey, places, (8, 8), (-1, -1), stop))
            size = grey.shape[1], grey.shape[0]
            sizes[size] = sizes.get(size, 0) + 1
    if len(corner_sets) < MIN_BOARDS:
        raise ValueError(
            f"{len(corner_sets)} of {len(paths)} files show a chessboard of {corners[0]} x "
            f"{corners[1]} inner corners; expected {MIN_BOARDS} or more"
        )
    if len(sizes) > 1:
        raise ValueError(f"the boards' photographs have different sizes: {sorted(sizes)}")
    (size,) = sizes
    start: Any = None
    error, K, dist, *_ = cv2.calibrateCamera(
        [board] * len(corner_sets), corner_sets, size, start, start
    )
    return Pinhole(K=tuple(map(tuple, K)), dist=tuple(dist.ravel()[:5]), size=size), float(error)
