"""The papers' claims: one module a paper, with its simulations, claims and figures."""

from . import dakf_stability, dual_rate, tie_vision, uneven_delay
from .claim import Claim
from .draw import PaperFigure
from .simulations import Simulation

_PAPERS = (tie_vision, uneven_delay, dual_rate, dakf_stability)

SIMULATIONS: dict[str, Simulation] = {
    simulation.name: simulation for paper in _PAPERS for simulation in paper.SIMULATIONS
}
CLAIMS: tuple[Claim, ...] = tuple(claim for paper in _PAPERS for claim in paper.CLAIMS)
FIGURES: tuple[PaperFigure, ...] = tuple(f for paper in _PAPERS for f in paper.FIGURES)
