"""One colour a name, in every picture, figure and table: the palette of Okabe and Ito, safe for the
colour-blind. Its yellow is left out (invisible on white); baselines are grey, facts are ink."""

import zlib

INK = "#000000"
"""Truth, reference, bound: black on white; the report turns it white on black."""
GREY = "#7F7F7F"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

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


def mixed(shade: str, with_shade: str, share: float) -> str:
    """A share of one colour with the rest of another.

    >>> mixed("#000000", "#FFFFFF", 0.2)
    '#cccccc'
    """
    pairs = [(int(shade[i : i + 2], 16), int(with_shade[i : i + 2], 16)) for i in (1, 3, 5)]
    return "#" + "".join(f"{round(a * share + b * (1.0 - share)):02x}" for a, b in pairs)
