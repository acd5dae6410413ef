"""Mixins that make an environment draw its cars; pygame is loaded with the first picture."""

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import logger
from gymnasium.error import ResetNeeded

from ..engine.layout import Episode, P, Z
from ..numerics.functions import TICK
from ..record import Array
from ..validation import check_choice
from .trace import EpisodeTrace, RenderState, RoadPainter

Frame = npt.NDArray[np.uint8]
_MODES = ("human", "rgb_array")
_TICKS_PER_FRAME = 20  # ticks of driving between two pictures in a window, or a control period


class _RenderMixin:
    """An environment of one or more cars that draws them, from what the engine wrote.

    `render_mode` is None, "rgb_array" (`render` returns frames, (540, 960, 3) bytes) or "human" (a
    window in which `reset` and `step` show the first car, in real time). The strip charts begin at
    an episode's first picture. An unknown mode raises ValueError; the first picture raises
    ModuleNotFoundError without pygame, ResetNeeded before a reset. Without a display one warning
    says that the window shows nothing.
    """

    _has_tyre_forces = True  # tyre forces can be drawn
    _has_shown = False  # a picture, in a window
    _draw_world: RoadPainter | None = None  # draws the road instead of ours
    control_period: int
    render_mode: str | None
    metadata: dict[str, Any] = {"render_modes": list(_MODES), "render_fps": 100}  # noqa: RUF012

    def _init_rendering(self, mode: str | None) -> None:
        """Take the render mode; `render_fps` is that of real time."""
        if mode is not None:
            check_choice("render_mode", mode, _MODES)
        self.render_mode = mode
        rate = max(round(1.0 / (self.control_period * TICK)), 1)
        self.metadata = {**self.metadata, "render_fps": rate}
        self._traces = [EpisodeTrace()] if mode == "human" else []

    def _get_episode(self, row: int) -> Episode:
        """Get a car's episode: views, which change with the car."""
        raise NotImplementedError

    def _record_step(self) -> None:
        """Record a reset or a step where `_traces` has some, and show it in the window."""
        for row, trace in enumerate(self._traces):
            episode = self._get_episode(row)
            trace.add(episode.report, episode.state)
        if self.render_mode == "human":  # an estimate behind: wrappers estimate later
            self._show()

    def _show(self) -> None:
        from .canvas import show_picture
        from .charts import draw_picture

        n, render_state = self.control_period, self.make_render_state(0)
        interval = n * max(-(-_TICKS_PER_FRAME // n), 1)
        if int(render_state.episode.state[Z.clock.tick]) % interval == 0:
            self._has_shown = True
            show_picture(draw_picture(render_state), 1.0 / (interval * TICK))

    def make_render_state(self, row: int = 0) -> RenderState:
        """Make what the picture of a row's car is drawn from, views that change with the car."""
        if not self._traces:
            self._traces = [EpisodeTrace() for _ in range(getattr(self, "num_envs", 1))]
        episode, trace = self._get_episode(row), self._traces[row]
        if not episode.params[P.car.m] > 0.0:
            raise ResetNeeded("there is nothing to draw yet: call reset() first")
        if not trace.rows:
            trace.add(episode.report, episode.state)
        return RenderState(episode, trace, self._has_tyre_forces, self._draw_world)

    def _render_frames(self) -> tuple[Frame, ...] | None:
        """Draw a frame of each car; None in a window and without a render mode."""
        if self.render_mode == "rgb_array":
            from .canvas import read_pixels
            from .charts import draw_picture

            states = map(self.make_render_state, range(getattr(self, "num_envs", 1)))
            return tuple(read_pixels(draw_picture(state)) for state in states)
        if self.render_mode == "human":
            self._show()
        else:
            logger.warn("render() draws nothing: the env was made without a render_mode")
        return None

    def _close_window(self, **kwargs: object) -> None:
        """Close the window, if there is one."""
        if self.render_mode == "human" and self._has_shown:
            from .canvas import pygame

            pygame.display.quit()


class SingleRenderMixin(_RenderMixin):
    """A single environment that draws its car."""

    annotations: dict[str, tuple[float, float]]  # estimates of the newest step

    def annotate(self, label: str, beta: float, std: float) -> None:
        """Annotate the newest step with a wrapper's estimate, to be drawn beside the truth.

        Args:
            label: Label of the estimate.
            beta: Sideslip angle (rad).
            std: Standard deviation (rad).
        """
        self.annotations[label] = beta, std
        if self._traces:
            self._traces[0].add_estimate(label, beta, std)

    def render(self) -> Frame | None:
        """Return the car's frame in the mode "rgb_array", else None."""
        frames = self._render_frames()
        return None if frames is None else frames[0]

    close = _RenderMixin._close_window


class VectorRenderMixin(_RenderMixin):
    """A vector environment that draws its cars."""

    def annotate(self, label: str, beta: Array, std: Array, rows: npt.NDArray[np.bool_]) -> None:
        """Annotate the newest step of some rows with a wrapper's estimates.

        Args:
            label: Label of the estimates.
            beta: Sideslip angles (rad), shape (N,).
            std: Standard deviations (rad), shape (N,).
            rows: Whether a row has an estimate, shape (N,).
        """
        for row in np.flatnonzero(rows[: len(self._traces)]):
            self._traces[row].add_estimate(label, beta[row], std[row])

    render = _RenderMixin._render_frames
    close_extras = _RenderMixin._close_window
