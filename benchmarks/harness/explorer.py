"""Any two cells of a table side by side: over time, and in motion where the place is known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ...envs.record import Array


@dataclass(frozen=True)
class Panel:
    """One of the plots above each other.

    Attributes:
        label: Quantity with its unit.
        lines: Names of signals and their texts in the legend; the first has the entry's colour, a
            "reference" is dashed.
    """

    label: str
    lines: Sequence[tuple[str, str]]


@dataclass
class Explorer:
    """Time series of which two are shown beside each other.

    Attributes:
        title: Title of the figure.
        menus: Label of each part of a cell's key but the last, for both sides; the last is the
            entry.
        cells: Signals of shape (n,) by key, with the time under "t" (s); with X, Y (m) and psi
            (rad) a cell is shown in motion.
        panels: Plots of the signals.
        caption: Caption, a sentence.
        pair: The two entries at the start.
        bodies: Length and width of the car (m) by the shared part of the key.

    Raises:
        ValueError: There are no cells, or a cell lacks a signal or a part of its key.
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
