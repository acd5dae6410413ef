"""The papers' claims: one or two modules a paper, with its simulations, claims and figures."""

from . import dakf_stability, double_layer, dual_rate, uneven_delay
from .ledger.claim import Claim
from .ledger.plots import PaperFigure
from .ledger.simulations import Simulation
from .theory import dual_rate_gains
from .tie_vision import control as tie_vision_control
from .tie_vision import convergence as tie_vision_convergence
from .tie_vision import estimation as tie_vision

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
