"""Any two cells of a table side by side: over time, and in motion where the place is known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Panel:
    """One of the plots above each other: quantity with unit, and its lines.

    lines: (name of a signal, what the legend calls it); the first in the contestant's colour, a
    "reference" dashed.
    """

    label: str
    lines: Sequence[tuple[str, str]]


@dataclass
class Explorer:
    """Time series of which two are shown beside each other.

    menus: what each part of a cell's key but the last is called; both sides share them. The last is
    the contestant. cells: key to signals, each (n,), with the time under "t"; with X, Y (m) and psi
    (rad) it is shown in motion. panels: what is drawn of them. pair: the two contestants to begin
    with. bodies: length and width of the car in m by the shared part of the key. caption: a
    sentence.
    """

    title: str
    menus: Sequence[str]
    cells: Mapping[tuple[str, ...], Mapping[str, Array]]
    panels: Sequence[Panel]
    caption: str = ""
    pair: tuple[str, str] = ("", "")
    bodies: Mapping[tuple[str, ...], tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.cells:
            raise ValueError(f"explorer {self.title!r} has no cells")
        for key, signals in self.cells.items():
            if len(key) != len(self.menus) + 1:
                raise ValueError(
                    f"cell {key} has {len(key)} names, {len(self.menus)} menus and a contestant "
                    f"make {len(self.menus) + 1}"
                )
            missing = {name for panel in self.panels for name, _ in panel.lines} - set(signals)
            if missing or "t" not in signals:
                raise ValueError(f"cell {key} lacks {', '.join(sorted(missing)) or 't'}")
