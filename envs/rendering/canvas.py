"""A canvas with smooth edges, and the window that shows pictures: one a process.

Shapes are drawn at twice their size and shrunk, text is not. Drawing needs no display.

Args:
    picture: Picture as a surface of pygame.
    box: Left, top, width and height (px); None: the whole picture.
    points: Points or corners (px), shape (n, 2).
    start: Foot of an arrow (px), shape (2,).
    end: Its tip (px), shape (2,).
    centre: Centre (px), shape (2,).
    radius: Radius (px), to the middle of the line.
    colour: Colour of what is drawn.
    width: Width of a line (px); 0 fills a circle.
"""

import functools
import os
import warnings
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from gymnasium import logger

from ..numerics import require_extra
from ..record import Array

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
with require_extra("render", "pictures need pygame"):
    import pygame as pygame  # the other files of the room take it from here

Points = npt.ArrayLike  # places, shape (n, 2), or one, shape (2,)
Box = tuple[float, float, float, float]  # left, top, width and height (px)
_OVERSAMPLING = 2
_FONTS = "dejavusans,notosans,liberationsans,arial,helveticaneue,segoeui"
_NO_WINDOW = ("offscreen", "dummy")  # SDL's drivers that show nothing


class Canvas:
    """A picture that shapes and text are drawn on.

    Places, widths and radii are in pixels of the result, x to the right and y down; colours are
    "#RRGGBB".

    Args:
        size: Width and height of the picture (px).
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self._large = pygame.Surface((size[0] * _OVERSAMPLING, size[1] * _OVERSAMPLING), 0, 32)
        self._texts: list[tuple[pygame.Surface, tuple[float, float]]] = []

    def set_clip(self, box: Box | None) -> None:
        """Limit the drawing of shapes to a box; text is never clipped."""
        self._large.set_clip(None if box is None else _scale_box(box))

    def draw_box(self, box: Box, colour: str, radius: float = 0.0) -> None:
        """Draw a filled box with round corners."""
        corner = round(_OVERSAMPLING * radius)
        pygame.draw.rect(self._large, colour, _scale_box(box), border_radius=corner)

    def draw_polygon(self, points: Points, colour: str) -> None:
        """Draw a filled polygon."""
        scaled = _scale_points(points)
        pygame.draw.polygon(self._large, colour, scaled)
        pygame.draw.aalines(self._large, colour, True, scaled)

    def draw_line(
        self, points: Points, colour: str, width: float = 1.0, dash: Sequence[float] = ()
    ) -> None:
        """Draw a line.

        Args:
            points: Points on it (px), shape (n, 2), two at least.
            colour: Its colour.
            width: Its width (px).
            dash: Length of a dash and of a gap (px); none: without gaps.
        """
        thick = max(round(_OVERSAMPLING * width), 1)
        if dash:
            scaled = _scale_points(_find_dashes(np.asarray(points, float), *dash))
            for start, end in zip(scaled[::2], scaled[1::2], strict=True):
                pygame.draw.line(self._large, colour, start, end, thick)
            return
        scaled = _scale_points(points)
        pygame.draw.lines(self._large, colour, False, scaled, thick)
        for point in scaled if thick > 4 else ():
            pygame.draw.circle(self._large, colour, point, thick / 2)

    def draw_disc(self, centre: Points, radius: float, colour: str, width: float = 0.0) -> None:
        """Draw a circle."""
        thick = max(round(_OVERSAMPLING * width), 1) if width else 0
        place, outer = _scale_points(np.atleast_2d(centre))[0], _OVERSAMPLING * radius + thick / 2
        pygame.draw.circle(self._large, colour, place, outer, thick)

    def draw_arrow(self, start: Points, end: Points, colour: str, width: float = 2.0) -> None:
        """Draw a line with a head at its end; the head shrinks with a short one."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        length = float(np.hypot(*(b - a)))
        if length < 1.0:
            return
        x, y = (b - a) / length
        normal, head = np.array([-y, x]), min(4.0 * width, 0.6 * length)
        neck, half = b - head * np.array([x, y]), 0.5 * width * normal
        self.draw_polygon([a + half, neck + half, neck - half, a - half], colour)
        self.draw_polygon([b, neck + 0.45 * head * normal, neck - 0.45 * head * normal], colour)

    def draw_text(
        self, place: Sequence[float] | Array, words: str, colour: str, size: int = 13,
        align: float = 0.0, bold: bool = False,
    ) -> float:  # fmt: skip
        """Draw words whose middle line passes a place; returns their width (px).

        Args:
            place: The place (px), shape (2,).
            words: Text in one line.
            colour: Their colour.
            size: Size of the font (px).
            align: 0 begins at the place, 1 ends there.
            bold: Whether they are bold.
        """
        surface = _render_words(words, colour, size, bold)
        width, height = surface.get_size()
        self._texts.append((surface, (place[0] - align * width, place[1] - 0.5 * height)))
        return float(width)

    def finish(self) -> pygame.Surface:
        """Finish the picture and return it; the canvas may be drawn upon anew."""
        small = pygame.transform.smoothscale(self._large, self.size)
        small.blits(self._texts)
        self._texts = []
        return small


def read_pixels(picture: pygame.Surface) -> npt.NDArray[np.uint8]:
    """Read the red, green and blue of a picture, shape (height, width, 3)."""
    return np.ascontiguousarray(pygame.surfarray.array3d(picture).swapaxes(0, 1))


def _find_dashes(vertices: Array, dash: float, gap: float) -> Array:
    """Find the ends of a line's dashes, one after the other, (n, 2)."""
    steps = np.hypot(*np.diff(vertices, axis=0).T)
    length = np.append(0.0, np.cumsum(steps))
    starts = np.arange(0.0, length[-1], dash + gap)
    ends = np.stack([starts, np.minimum(starts + dash, length[-1])], 1).ravel()
    return np.stack([np.interp(ends, length, coordinate) for coordinate in vertices.T], 1)


def _scale_box(box: Box) -> list[int]:
    return [round(_OVERSAMPLING * value) for value in box]


def _scale_points(points: Points) -> list[tuple[int, int]]:
    """Scale places to the large surface; what lies far outside is clipped at 4000 pixels."""
    scaled = np.clip(np.asarray(points, float), -4000.0, 4000.0) * _OVERSAMPLING
    return [(x, y) for x, y in np.rint(scaled).astype(int).tolist()]


@functools.cache
def _load_font(size: int, bold: bool) -> pygame.font.Font:
    pygame.font.init()
    with warnings.catch_warnings():  # no list of fonts within a second, or none of these: its own
        warnings.simplefilter("ignore", UserWarning)
        return pygame.font.SysFont(_FONTS, size, bold)


@functools.lru_cache(512)
def _render_words(words: str, colour: str, size: int, bold: bool) -> pygame.Surface:
    try:
        return _load_font(size, bold).render(words, True, colour)
    except pygame.error:  # somebody's window called pygame.quit(), which ends all fonts
        _load_font.cache_clear()
        return _load_font(size, bold).render(words, True, colour)


_get_clock = functools.cache(pygame.time.Clock)


def show_picture(picture: pygame.Surface, rate: float) -> None:
    """Show a picture in the window, no sooner than 1 / rate seconds after the last one.

    Args:
        picture: Picture as a surface of pygame.
        rate: Pictures a second.
    """
    screen = pygame.display.get_surface() or _make_screen(picture.get_size())
    screen.blit(picture, (0, 0))
    pygame.event.pump()
    pygame.display.flip()
    _get_clock().tick(rate)


def _make_screen(size: tuple[int, int]) -> pygame.Surface:
    """Open the window; without a display warn, and go on with one that shows nothing."""
    try:
        pygame.display.init()
        driver = pygame.display.get_driver()
        if driver in _NO_WINDOW and os.environ.get("SDL_VIDEODRIVER") not in _NO_WINDOW:
            raise pygame.error("SDL finds no screen")
        screen = pygame.display.set_mode(size)
    except pygame.error as error:
        pygame.display.quit()
        if os.environ.get("SDL_VIDEODRIVER") in _NO_WINDOW:
            raise
        logger.warn(
            f"there is no display ({error}): what render_mode='human' draws is not shown; "
            "render_mode='rgb_array' returns frames"
        )
        os.environ["SDL_VIDEODRIVER"] = "dummy"
        return _make_screen(size)
    pygame.display.set_caption("sideslip")
    return screen
