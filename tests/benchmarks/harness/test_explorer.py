"""The figure with menus: its data round trip, and keys or signals that do not fit."""

import json
import re

import numpy as np
import pytest

from sideslip.benchmarks.harness.explorer import POINTS, Explorer, Panel

PANELS = (Panel("slip / mrad", (("beta", "true", "#0072B2"),)),)


def test_the_page_holds_every_cell_thinned() -> None:
    t = np.linspace(0.0, 10.0, 1001)
    cells = {("a</script>", "x"): {"t": t, "beta": np.sin(t)}, ("b", ""): {"t": t, "beta": t}}
    html = Explorer("Any cell", ("manoeuvre", "controller"), cells, PANELS, "So.").html()
    assert html.count("</script>") == 1
    found = json.loads(re.search(r"json\">(.*?)</script>", html, re.DOTALL)[1])  # type: ignore[index]
    assert [key for key, _ in found["cells"]] == [["a</script>", "x"], ["b", ""]]
    signals = found["cells"][0][1]
    assert len(signals["t"]) == len(signals["beta"]) == POINTS
    assert np.allclose(signals["beta"], np.sin(signals["t"]), atol=2e-3)
    assert signals["t"][-1] == 10.0


def test_what_does_not_fit_is_refused() -> None:
    t = np.zeros(3)
    with pytest.raises(ValueError, match="no cells"):
        Explorer("x", ("a",), {}, PANELS)
    with pytest.raises(ValueError, match="2 names, there are 1"):
        Explorer("x", ("a",), {("p", "q"): {"t": t, "beta": t}}, PANELS)
    with pytest.raises(ValueError, match="lacks beta"):
        Explorer("x", ("a",), {("p",): {"t": t}}, PANELS)
