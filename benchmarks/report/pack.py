"""Figures and texts made small for the page, which unpacks them: gzip in base64, lines as steps."""

import base64
import gzip
import json
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt

_LONG = 40  # a shorter array is left as it is
_LEVELS = {"x": 2**13, "y": 2**11}  # more than a screen has pixels


def pack_text(text: str) -> str:
    """A text as the page's `unpack` takes it; the same text gives the same letters."""
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()


def encode_steps(values: npt.ArrayLike, levels: int = _LEVELS["y"]) -> dict[str, Any]:
    """(n,) numbers as steps from one to the next in whole quanta, null for a gap.

    levels: how many quanta the range has.

    >>> encode_steps([1.0, 2.0, float("nan"), 3.0], levels=3)
    {'from': 1.0, 'by': 1.0, 'steps': [0, 1, None, 1]}
    """
    v = np.asarray(values, float)
    finite = np.isfinite(v)
    low, high = (float(v[finite].min()), float(v[finite].max())) if finite.any() else (0.0, 0.0)
    by = (high - low) / (levels - 1) or 1.0
    quanta = np.round((v[finite] - low) / by).astype(int)
    encoded: list[int | None] = [None] * len(v)
    for i, step in zip(np.flatnonzero(finite), np.diff(quanta, prepend=0), strict=True):
        encoded[i] = int(step)
    return {"from": low, "by": by, "steps": encoded}


def encode_figure(figure: Any) -> str:
    """A plotly figure's data and layout as JSON, without the template and the title."""
    from plotly.utils import PlotlyJSONEncoder

    content = figure.to_plotly_json()
    for name in ("template", "title"):
        content["layout"].pop(name, None)
    for trace, plain in zip(figure.data, content["data"], strict=True):
        for axis, levels in _LEVELS.items():
            values = getattr(trace, axis, None)
            if _is_line(values):
                plain[axis] = encode_steps(values, levels)
    plain = {name: content[name] for name in ("data", "layout") if content.get(name)}
    return json.dumps(plain, cls=PlotlyJSONEncoder, separators=(",", ":"))


def _is_line(values: Any) -> TypeGuard[npt.NDArray[np.floating[Any]]]:
    """Whether values are many enough, in a row, to be worth their steps."""
    return (
        isinstance(values, np.ndarray)
        and values.dtype.kind == "f"
        and values.ndim == 1
        and len(values) > _LONG
    )
