"""Two cells side by side: keys or signals that do not fit are refused."""

import numpy as np
import pytest

from sideslip.benchmarks.harness.verdict import Explorer, Panel

PANELS = (Panel("slip / mrad", (("beta", "true"),)),)


def test_what_does_not_fit_is_refused() -> None:
    t = np.zeros(3)
    with pytest.raises(ValueError, match="no cells"):
        Explorer("x", ("a",), {}, PANELS)
    with pytest.raises(ValueError, match="has 1 names, 1 menus and a contestant make 2"):
        Explorer("x", ("a",), {("p",): {"t": t, "beta": t}}, PANELS)
    with pytest.raises(ValueError, match="lacks beta"):
        Explorer("x", (), {("p",): {"t": t}}, PANELS)
