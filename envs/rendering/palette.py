"""One colour a name in every picture, figure and table: each method has its own.

The colours are spread as far as possible in OKLab, for eyes without red or green cones too, those
of names that meet in figures the furthest. All stand out from white and from the dark page.

Args:
    name: Label of a curve or of a car.
"""

import zlib

INK = "#000000"
"""Truth, reference, bound: black on white; the report turns it white on black."""
GREY = "#7F7F7F"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Of things: Okabe and Ito's, safe for the colour-blind, without the yellow that white swallows."""
OTHER_COLOURS = ("#AB1B99", "#907EFC", "#BD3F09", "#D87E12")
"""Of methods that are not ours, such as a user's own."""
FILTERS = {
    "bicycle-kf": "#EA75FC", "single-rate-kf": "#995AFC", "multirate-kf": "#00A275",
    "multirate-residual-kf": "#BD247E", "uneven-delay-kf": "#BD99B4",
    "constant-delay-kf": "#90903F", "vision-only-kf": "#E124A2", "course-kf": "#FC5A48",
    "dakf": "#994824", "double-layer": "#096C5A", "lob-2": "#7587C6", "roll-kf": "#BD5A24",
    "kinematic-velocity-kf": "#F35190", "dual-rate": "#36B4CF", "lob": "#633FE1",
    "yaw-moment-observer": "#996C6C", "lateral-force-observer": "#EA9048", "exact-kf": "#0075B4",
    "joint": "#1B9E1B",
}  # fmt: skip
CONTROLLERS = {
    "none": GREY, "feedforward": "#C6A200", "two-dof": "#CF75AB", "model-following": "#1BBD75",
    "esc": "#755A75", "sliding-mode": "#C61248", "lqr": "#D85A00", "mpc": "#127EE1",
    "nmpc": "#3F3FFC", "adaptive-lqr": "#A84300", "adaptive-nmpc": "#5A36FC",
    "lane-keeping": "#486C3F", "learned": "#D8636C",
    "distill-coms-steering": "#8C6D1F", "distill-coms-yaw": "#2E8B9E",
    "distill-car-steering": "#B0603A", "distill-car-yaw": "#5E8F2E",
    "raw-car-steering": "#7A7F1B", "raw-coms-steering": "#A0527D",
}  # fmt: skip
ORACLES = {
    "nominal": "#CF00B4", "oracle-parameters": "#63905A", "oracle-parameters-lqr": "#48905A",
    "oracle-parameters-nmpc": "#6CA290", "oracle-state": "#00ABFC", "oracle-state-lqr": "#9090CF",
    "oracle-state-nmpc": "#5A5ACF", "clairvoyant": "#FC7E99",
}  # fmt: skip

# What the papers' figures call them.
_ALIASES = {
    "without control": "none", "gyro-only": "bicycle-kf", "single-rate": "single-rate-kf",
    "conventional": "single-rate-kf", "multirate": "multirate-kf",
    "innovation holding": "multirate-kf", "multirate-residual": "multirate-residual-kf",
    "pseudo-residuals": "multirate-residual-kf", "pseudo measurement": "multirate-residual-kf",
    "with control": "model-following", "both": "model-following", "true": "truth",
    "reference": "truth", "bound": "truth", "ideal": "truth",
}  # fmt: skip
_BASE_COLOURS = {**FILTERS, **CONTROLLERS, **ORACLES, "truth": INK, "measured": GREY}
COLOURS = _BASE_COLOURS | {alias: _BASE_COLOURS[name] for alias, name in _ALIASES.items()}
"""Estimators, controllers and facts by name."""

FACTS = ("truth", "true")
_NAMES = [name for name in COLOURS if name not in (*FACTS, "none")]
_LONGEST_FIRST = sorted(_NAMES, key=len, reverse=True)
_DEFAULT_PREFIX = "lqr on "  # the controller under which filters are compared


def find_base(name: str) -> str | None:
    """Find the name of `COLOURS` in a label, None for an unknown one.

    Of a controller on an estimator it is the controller, unless that is the usual one.

    >>> find_base("exact-kf, true model"), find_base("the bound"), find_base("a stranger")
    ('exact-kf', 'bound', None)
    >>> find_base("two-dof on multirate-kf"), find_base("lqr on dakf")
    ('two-dof', 'dakf')
    """
    name = name.removeprefix(_DEFAULT_PREFIX).partition(" on ")[0]
    return name if name in COLOURS else next((n for n in _LONGEST_FIRST if n in name), None)


def find_colour(name: str) -> str:
    """Find the colour of a label; an unknown one always gets the same."""
    other = OTHER_COLOURS[zlib.crc32(name.encode()) % len(OTHER_COLOURS)]
    return COLOURS.get(find_base(name) or "", other)


def mix_colours(shade: str, with_shade: str, share: float) -> str:
    """Mix two colours to one, "#rrggbb" in lower case.

    >>> mix_colours("#000000", "#FFFFFF", 0.2)
    '#cccccc'

    Args:
        shade: One colour, "#RRGGBB".
        with_shade: The other colour.
        share: Fraction of the first, from 0 to 1.
    """
    pairs = [(int(shade[i : i + 2], 16), int(with_shade[i : i + 2], 16)) for i in (1, 3, 5)]
    return "#" + "".join(f"{round(a * share + b * (1.0 - share)):02x}" for a, b in pairs)
