"""The trace of an episode: truth and estimates of its steps so far, and the state of a picture."""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..engine.layout import Episode, Z
from ..record import Array
from ..task import REPORT
from ..vehicle.dynamics import Motion

if TYPE_CHECKING:
    import pygame


class TracePoint(NamedTuple):
    """Columns of the truth at an instant."""

    t: int = 0  # s
    beta: int = 1  # rad
    gamma: int = 2  # rad/s
    beta_ref: int = 3
    gamma_ref: int = 4
    yaw_moment: int = 5  # N m
    X: int = 6  # m, on the ground
    Y: int = 7
    s: int = 8  # m, along the road
    y: int = 9  # m, left of its centre line
    theta: int = 10  # rad, its direction


TRACE_POINT = TracePoint()
_REPORT_COLUMNS = [getattr(REPORT, name) for name in TracePoint._fields[: TRACE_POINT.X]]
_STATE_COLUMNS = [getattr(Z.motion, name) for name in TracePoint._fields[TRACE_POINT.X :]]
_UNKNOWN = (np.nan, np.nan)


class EpisodeTrace:
    """The recorded steps of an episode: truth and estimates."""

    def __init__(self) -> None:
        self.rows: list[Array] = []  # the truth, shape (len(TracePoint),) each
        self._estimates: list[dict[str, tuple[float, float]]] = []  # of each row, by label

    def add(self, report: Array, state: Array) -> None:
        """Add a step; one before the last begins a new episode, one at its time replaces it.

        Args:
            report: Report of the step, shape (len(StepReport),).
            state: Packed state of the car.
        """
        if self.rows and report[REPORT.t] < self.rows[-1][TRACE_POINT.t]:
            self.rows, self._estimates = [], []
        row = np.concatenate([report[_REPORT_COLUMNS], state[_STATE_COLUMNS]])
        if self.rows and row[TRACE_POINT.t] == self.rows[-1][TRACE_POINT.t]:
            self.rows[-1] = row  # it did not move: another row of the env was reset
        else:
            self.rows.append(row)
            self._estimates.append({})

    def add_estimate(self, label: str, value: float, deviation: float) -> None:
        """Add an estimate of the sideslip angle to the newest step.

        Args:
            label: Label of the estimate.
            value: Sideslip angle (rad).
            deviation: Standard deviation (rad).
        """
        self._estimates[-1][label] = value, deviation

    def select_since(self, t: float, max_points: int = 400) -> tuple[Array, dict[str, Array]]:
        """Select the steps from a time on, thinned out.

        Args:
            t: Time (s).
            max_points: Number of steps that remain, or up to twice as many.

        Returns:
            The truth, (n, len(TracePoint)), and by label estimates and deviations (rad), (n, 2).
        """
        times = [row[TRACE_POINT.t] for row in self.rows]
        first = int(np.searchsorted(times, t))
        step = max((len(times) - first) // max_points, 1)
        chosen = range(len(times) - 1, first - 1, -step)[::-1]
        labels = dict.fromkeys(label for by_label in self._estimates for label in by_label)
        estimates = {
            label: np.array([self._estimates[k].get(label, _UNKNOWN) for k in chosen])
            for label in labels
        }
        return np.array([self.rows[k] for k in chosen]), estimates


RoadPainter = Callable[[tuple[int, int], list[Motion]], "pygame.Surface"]
"""Draws a road around a car, and others at their motions, on a surface of so many pixels."""


class RenderState(NamedTuple):
    """State that a picture is drawn from: an episode's packed numbers and its recorded steps."""

    episode: Episode
    trace: EpisodeTrace
    has_tyre_forces: bool = True  # its tyres are those of our plant
    world: RoadPainter | None = None  # draws the road instead
