"""The window of render_mode "human": one a process, as pygame has it."""

import functools
import os

import gymnasium as gym

from .canvas import pygame

_NO_WINDOW = ("offscreen", "dummy")  # SDL's drivers that show nothing


@functools.cache
def _get_clock() -> pygame.time.Clock:
    return pygame.time.Clock()


def _make_screen(size: tuple[int, int]) -> pygame.Surface:
    try:
        pygame.display.init()
        driver = pygame.display.get_driver()
        if driver in _NO_WINDOW and os.environ.get("SDL_VIDEODRIVER") not in _NO_WINDOW:
            raise pygame.error("SDL finds no screen")
        screen = pygame.display.set_mode(size)
    except pygame.error as error:
        close()
        if os.environ.get("SDL_VIDEODRIVER") in _NO_WINDOW:
            raise
        gym.logger.warn(
            f"there is no display ({error}): what render_mode='human' draws is not shown; "
            "render_mode='rgb_array' returns frames"
        )
        os.environ["SDL_VIDEODRIVER"] = "dummy"
        return _make_screen(size)
    pygame.display.set_caption("sideslip")
    return screen


def show(picture: pygame.Surface, rate: float) -> None:
    """Show a picture, no sooner than 1 / rate seconds after the last one.

    Args:
        picture: The picture.
        rate: Pictures a second.
    """
    screen = pygame.display.get_surface() or _make_screen(picture.get_size())
    screen.blit(picture, (0, 0))
    pygame.event.pump()
    pygame.display.flip()
    _get_clock().tick(rate)


def close() -> None:
    """Close the window."""
    pygame.display.quit()
