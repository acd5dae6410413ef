"""The papers' claims: one or two modules a paper, with its simulations, claims and figures."""

from . import (
    dakf_stability,
    double_layer,
    dual_rate,
    dual_rate_gains,
    tie_vision,
    tie_vision_control,
    tie_vision_convergence,
    uneven_delay,
)
from .claim import Claim
from .draw import PaperFigure
from .simulations import Simulation

_MODULES = (
    tie_vision,
    tie_vision_control,
    tie_vision_convergence,
    uneven_delay,
    double_layer,
    dual_rate,
    dual_rate_gains,
    dakf_stability,
)

SIMULATIONS: dict[str, Simulation] = {
    simulation.name: simulation for module in _MODULES for simulation in module.SIMULATIONS
}
CLAIMS: tuple[Claim, ...] = tuple(claim for module in _MODULES for claim in module.CLAIMS)
FIGURES: tuple[PaperFigure, ...] = tuple(f for module in _MODULES for f in module.FIGURES)
