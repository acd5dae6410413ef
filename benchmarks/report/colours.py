"""One colour a name in every figure and table: the palette of Okabe and Ito, safe for the
colour-blind. Its yellow is left out (invisible on white); baselines are grey, facts are ink."""

import zlib
from collections.abc import Iterable

INK = "#000000"
"""Truth, reference, bound: black on white; the report turns it white on black."""
GREY = "#7F7F7F"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

SHARE_SCALE = ((0.0, "#D55E00"), (0.5, "#F0E442"), (1.0, "#0072B2"))
"""From bad to good, safe for the colour-blind."""

_NAMES = {
    INK: "truth, true, reference, bound, ideal",
    GREY: "none, measured, bicycle-kf, gyro-only, without control",
    "#D55E00": "single-rate, single-rate-kf, constant-delay-kf, lob, lob-2",
    "#0072B2": "multirate, multirate-kf, double-layer, pseudo measurement, with control",
    "#009E73": "multirate-residual, multirate-residual-kf, uneven-delay-kf, pseudo-residuals",
    "#CC79A7": "course-kf, roll-kf, innovation holding, two-dof",
    "#E69F00": "dakf, kinematic-velocity-kf, conventional, feedforward",
    "#56B4E9": "exact-kf, vision-only-kf",
}
COLOURS = {name: shade for shade, names in _NAMES.items() for name in names.split(", ")}
"""Estimators, controllers and facts by name."""

FACTS = ("truth", "true")
_DASHES = {"reference": "dash", "bound": "dot"}
_ORDER = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
_WITHIN = sorted((name for name in COLOURS if name not in (*FACTS, "none")), key=len, reverse=True)


def base(name: str) -> str | None:
    """The name of `COLOURS` that a label speaks of, None for a stranger.

    >>> base("exact-kf, true model"), base("the bound"), base("a stranger")
    ('exact-kf', 'bound', None)
    """
    return name if name in COLOURS else next((known for known in _WITHIN if known in name), None)


def colour(name: str) -> str:
    """The colour of a label, as "#RRGGBB"; a stranger always gets the same one of the palette.

    >>> colour("multirate-kf"), colour("two-dof on multirate-kf")
    ('#0072B2', '#0072B2')
    """
    known = base(name)
    return COLOURS[known] if known else PALETTE[zlib.crc32(name.encode()) % len(PALETTE)]


def line_styles(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """(colour, dash) of each line of a figure: no two alike, a variant of a known name dashed.

    >>> line_styles(["exact-kf", "exact-kf, true model"])
    {'exact-kf': ('#56B4E9', 'solid'), 'exact-kf, true model': ('#56B4E9', 'dash')}
    """
    styles: dict[str, tuple[str, str]] = {}
    for name in names:
        known = base(name)
        first = _DASHES.get(known or "", "solid" if known in (name, None) else "dash")
        choices = [(colour(name), dash) for dash in (first, *_ORDER)]
        taken = styles.values()
        styles[name] = next((style for style in choices if style not in taken), choices[0])
    return styles
