"""The lines of figures: no two alike, a name's colour that of `envs.rendering.palette`."""

from collections.abc import Iterable

from ...envs.rendering.palette import find_base, find_colour

SHARE_SCALE = ((0.0, "#D55E00"), (0.5, "#F0E442"), (1.0, "#0072B2"))
"""From bad to good, safe for the colour-blind."""

_DASHES = {"reference": "dash", "bound": "dot"}
_ORDER = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")


def choose_line_styles(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """(colour, dash) of each line of a figure: no two alike, a variant of a known name dashed.

    >>> [dash for _, dash in choose_line_styles(["exact-kf", "exact-kf, true model"]).values()]
    ['solid', 'dash']
    """
    styles: dict[str, tuple[str, str]] = {}
    for name in names:
        known = find_base(name)
        first = _DASHES.get(known or "", "solid" if known in (name, None) else "dash")
        choices = [(find_colour(name), dash) for dash in (first, *_ORDER)]
        taken = styles.values()
        styles[name] = next((style for style in choices if style not in taken), choices[0])
    return styles
