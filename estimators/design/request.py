"""What is wished for: from a row of the table and options to slow sensors, gains and models."""

from collections.abc import Mapping
from dataclasses import dataclass

from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import SLOW_NAMES
from ..core.delay import RULES
from ..filters import Filter
from . import dual_rate as spread
from .models import MODELS, Model, bicycle_model
from .options import Options, poles_of
from .pseudo_gains import INVERSES


@dataclass(frozen=True)
class Wish:
    """What a filter's gains shall be: `periodic.design` reads it.

    gains: "periodic", "covariance", "placed"; of the rule "spread" one of `spread.GAINS`.
    inverse: of `intersample.INVERSES`. rule: of `spread.RULES`, or of a second layer's filters.
    poles: rad/s. late: of `delay.RULES`. assumed: s, of the rule "constant". between: "hold" or
    "predict", of a filter at the slow sensor's rate.
    """

    gains: str
    inverse: str
    rule: str
    poles: tuple[float, ...]
    late: str
    assumed: float
    between: str


def slow_sensors(
    name: str, row: Filter, there: Mapping[str, SlowSensor], told: Options
) -> tuple[str, ...]:
    """The slow sensors to use, in the order of `SLOW_NAMES`; takes the option `slow`.

    Raises ValueError for a sensor that is absent or that the filter cannot use.
    """
    wish = told.take("slow", None)
    if not row.slow:
        if wish is not None:
            raise ValueError(f"{name} uses no slow sensor, got slow={wish!r}")
        return ()
    if wish is None:
        wished = [sensor for sensor in row.slow if sensor in there][:1] or [" or ".join(row.slow)]
    else:
        wished = [wish] if isinstance(wish, str) else list(wish)
    for sensor in wished:
        if wish is not None and sensor not in row.slow:
            raise ValueError(f"{name} can use {' or '.join(row.slow)}, got slow={wish!r}")
        if sensor not in there:
            present = ", ".join(there) or "none"
            raise ValueError(f"{name} needs the slow sensor {sensor}; there is: {present}")
    return tuple(sensor for sensor in SLOW_NAMES if sensor in wished)


def wish_of(name: str, row: Filter, used: tuple[str, ...], told: Options) -> Wish:
    """How the gains shall be found; ValueError for options that exclude each other."""
    spreads, placed = row.intersample == "spread", row.gains == "placed"
    rule = told.one_of("intersample", "pseudo", spread.RULES) if spreads else ""
    if row.second:
        rule = told.one_of("intersample", "pseudo-residual", ("pseudo-residual", "predict"))
    known = spread.GAINS if spreads else ("", "periodic", "covariance")
    gains = row.gains if placed else told.one_of("gains", known[0], known)
    if gains == "from-29" and rule != "pseudo":
        raise ValueError(f"{name}: gains 'from-29' are those of intersample='pseudo'")
    between = "hold"
    if row.intersample == "single-rate":
        between = told.one_of("between", "hold", ("hold", "predict"))
    inverse = told.one_of("inverse", INVERSES[0], INVERSES)
    late = told.one_of("delay", row.delay, RULES)
    assumed = told.positive("assumed_delay", 0.033) if late == "constant" else 0.0
    poles = poles_of(name, row.poles, told) if placed or gains == "placed" else ()
    if gains == "placed" and not poles:
        raise ValueError(f"{name}: gains='placed' needs poles")
    if late in ("literal", "lag") and "camera" not in used:
        raise ValueError(f"{name}: delay={late!r} is tie-vision's, for the camera")
    return Wish(gains, inverse, rule, poles, late, assumed, between)


def models_of(row: Filter, used: tuple[str, ...], wish: Wish, told: Options) -> list[Model]:
    """The model of each layer; takes the option `disturbances` of a bicycle."""
    if row.model != "bicycle":
        return [MODELS[row.model]]
    kinds = ("none", "walk", "walk-all", "forces")
    disturbances = told.one_of("disturbances", row.disturbances, kinds)
    first = bicycle_model(used, row.fast, disturbances, wish.late in ("literal", "lag"))
    return [first, MODELS[row.second]] if row.second else [first]
