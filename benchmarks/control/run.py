"""All cells driven: the episodes of each."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console

from ..harness.parallel import run_cases
from .cache import CachedDrive
from .cells import EPISODES, INFORMED, SLOW_EPISODES, Cell
from .episodes import Chunk, Driven
from .seeds import salted_seeds

CHUNK = 250
NOTEWORTHY = 2.0  # times informed's cost: what the uncontrolled car's is where control matters


@dataclass
class Results:
    """Every cell's episodes and the salt of the seeds."""

    salt: str
    found: dict[Cell, Driven] = field(default_factory=dict)

    def of(self, env_id: str, scenario: str, controller: str, estimator: str = "") -> Driven:
        """One cell; KeyError if it was not asked for."""
        return self.found[Cell(env_id, scenario, estimator, controller)]

    def worth_controlling(self, env_id: str, scenario: str) -> bool:
        """Whether the uncontrolled car costs more than twice what informed does."""
        none, informed = (self.of(env_id, scenario, who).costs for who in ("none", INFORMED))
        return bool(none.mean() > NOTEWORTHY * informed.mean())


def measure(
    cells: Sequence[Cell],
    episodes: int = EPISODES,
    *,
    salt: str,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
) -> Results:
    """Drive every cell on the first `episodes` test seeds of the salt (slow ones on fewer)."""
    seeds = salted_seeds(salt, episodes)
    chunks = []
    for cell in cells:
        mine = seeds[:SLOW_EPISODES] if cell.slow else seeds
        chunks += [
            Chunk(cell, tuple(mine[first : first + CHUNK]), keep=first == 0)
            for first in range(0, len(mine), CHUNK)
        ]
    driven = run_cases(CachedDrive(keep, salt), chunks, "control", jobs, console)
    results = Results(salt)
    for cell in cells:
        mine_driven = [d for c, d in zip(chunks, driven, strict=True) if c.cell is cell]
        results.found[cell] = _joined(mine_driven)
    return results


def _joined(parts: list[Driven]) -> Driven:
    return Driven(
        np.concatenate([part.numbers for part in parts]),
        sum(part.seconds for part in parts),
        parts[0].series,
        next((part.error for part in parts if part.error), ""),
    )
