"""tie-vision Fig. 8: what PAPERS section 3 asks of the controllers, filters told their camera."""

import numpy as np
import pytest

from sideslip.benchmarks.control import CONTESTANTS, METRICS, Case, measure, told_noise

SLIP, STEP = METRICS.index("rms_slip"), METRICS.index("largest_step")
SEEDS = range(8)


def means(scenario: str) -> dict[str, np.ndarray]:
    """The metrics' means over the seeds, by contestant."""
    return {
        contestant.label: np.mean(
            [measure(Case(scenario, k, seed)).numbers for seed in SEEDS], axis=0
        )
        for k, contestant in enumerate(CONTESTANTS)
        if contestant.label != "feedforward"
    }


def test_filters_are_told_the_scenarios_camera() -> None:
    assert told_noise("tie-vision-fig8") == {"psi_noise": 0.0005, "y_l_noise": 0.003}
    assert told_noise("tie-vision-fig7") == {}


@pytest.mark.long
def test_fig8_with_tyres_as_believed() -> None:
    """Control at most 0.40 of none, multirate 0.92 of single-rate, its steps 0.4 with residuals."""
    found = means("tie-vision-fig8")
    single = found["single-rate"]
    assert single[SLIP] <= 0.40 * found["none"][SLIP]
    for better in ("multirate", "multirate-residual"):
        assert found[better][SLIP] <= 0.92 * single[SLIP]
    assert found["multirate-residual"][STEP] <= 0.4 * single[STEP]


@pytest.mark.long
def test_fig8_with_stiffer_tyres() -> None:
    found = means("tie-vision-fig8-stiff")
    for label in ("single-rate", "multirate", "multirate-residual"):
        assert found[label][SLIP] <= 0.55 * found["none"][SLIP]
