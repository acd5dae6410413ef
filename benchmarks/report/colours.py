"""One colour a name in every figure and table: the palette of Okabe and Ito, safe for the
colour-blind. Its yellow is left out (invisible on white); baselines are grey, facts are ink."""

import zlib
from collections.abc import Iterable

INK = "#000000"
"""Truth, reference, bound: black on white; the report turns it white on black."""
GREY = "#7F7F7F"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

COLOURS = {
    "truth": INK,
    "true": INK,
    "reference": INK,
    "bound": INK,
    "none": GREY,
    "measured": GREY,
    "bicycle-kf": GREY,
    "gyro-only": GREY,
    "single-rate": "#D55E00",
    "single-rate-kf": "#D55E00",
    "multirate": "#0072B2",
    "multirate-kf": "#0072B2",
    "multirate-residual": "#009E73",
    "multirate-residual-kf": "#009E73",
    "course-kf": "#CC79A7",
    "dakf": "#E69F00",
    "exact-kf": "#56B4E9",
    "uneven-delay-kf": "#009E73",
    "constant-delay-kf": "#D55E00",
    "vision-only-kf": "#56B4E9",
    "double-layer": "#0072B2",
    "lob": "#D55E00",
    "lob-2": "#D55E00",
    "roll-kf": "#CC79A7",
    "kinematic-velocity-kf": "#E69F00",
    "conventional": "#E69F00",
    "innovation holding": "#CC79A7",
    "pseudo measurement": "#0072B2",
    "pseudo-residuals": "#009E73",
    "without control": GREY,
    "with control": "#0072B2",
    "ideal": INK,
    "feedforward": "#E69F00",
    "two-dof": "#CC79A7",
}
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
