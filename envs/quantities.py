"""Quantities: fields of a dataclass with a unit and the range that is plausible of a car."""

import dataclasses
import math
from typing import Any

from .arguments import short_repr

_CONFUSED_UNITS = {  # units in which a number may be instead, as shares of the right one
    "m": {"mm": 1e-3, "cm": 1e-2},
    "s": {"ms": 1e-3},
    "m/s": {"km/h": 1.0 / 3.6},
    "rad": {"deg": math.pi / 180.0},
    "rad/s": {"deg/s": math.pi / 180.0},
    "kg": {"t": 1e3},
    "N/rad": {"kN/rad": 1e3, "N/deg": 180.0 / math.pi},
    "-": {"%": 1e-2},
}


def quantity(
    unit: str,
    low: float,
    high: float,
    text: str = "",
    default: Any = dataclasses.MISSING,
    per: tuple[str, ...] = (),
) -> Any:
    """A field whose numbers are plausible from low to high, each times the fields `per`; where low
    is above zero, they are positive at any rate."""
    metadata = {"unit": unit, "text": text, "plausible": (low, high), "per": per}
    return dataclasses.field(default=default, metadata=metadata)


def check_plausible(values: Any) -> None:
    """Raise ValueError for a number of a dataclass outside its range, with the unit that it may be
    in by mistake."""
    entries = [spec for spec in dataclasses.fields(values) if "plausible" in spec.metadata]
    for entry in sorted(
        entries, key=lambda spec: len(spec.metadata["per"])
    ):  # those last go by others
        unit, _, (low, high), per = entry.metadata.values()
        value, scale = getattr(values, entry.name), math.prod(getattr(values, n) for n in per)
        low, high = scale * low, scale * high
        for number in value if isinstance(value, tuple) else (value,):
            if number is None or low <= number <= high:
                continue
            per_text = f" for its {', '.join(per)}" if per else ""
            units = _CONFUSED_UNITS.get(unit, {}).items()
            candidates = " or ".join(name for name, size in units if low <= number * size <= high)
            got = f"{type(values).__name__}.{entry.name}: {short_repr(number)} {unit}".removesuffix(
                " -"
            )
            raise ValueError(
                f"{got} is outside the plausible {low:.4g} to {high:.4g}{per_text}"
                f"{f' (is it in {candidates}?)' if candidates else ''}; strict=False takes it"
            )
