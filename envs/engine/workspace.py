"""Arrays of an episode; its workspace, one vector that holds them."""

from typing import Any, NamedTuple

import numpy as np

from ..numerics.jit import as_python, jit
from ..numerics.packed import as_float32, as_int64, as_matrix, make_offsets, read
from ..numerics.primitives import Matrix, Scalar, Vector
from ..record import FAST_WIDTH, PACKET_WIDTH, Array
from ..task import REPORT
from .layout import FLAGS, PARAMS_WIDTH, STATE_WIDTH
from .window import WINDOW_HEIGHT, count_columns


class EpisodeArrays(NamedTuple):
    """One episode's arrays."""

    # (PARAMS_WIDTH,), packed as in `EpisodeParams`; behind it a recorded trace, if there is one
    p: Vector
    z: Vector  # (STATE_WIDTH,), packed as in `_EpisodeState`
    switches: Vector  # (len(Switches),) int64
    obs: Vector  # (k,) float32
    rows: Matrix  # (n, FAST_WIDTH), the fast rows of the newest record
    packets: Matrix  # (max, PACKET_WIDTH), its packets
    report: Vector  # (len(Report),)


class _WorkspaceSizes(NamedTuple):
    """Sizes at the beginning of a workspace."""

    n: Scalar  # ticks a step
    n_entries: Scalar  # of an observation
    max_packets: Scalar  # packets of a step


SIZES, _HEADER = make_offsets(_WorkspaceSizes)


def _make_workspace(n: int, bounds: Array, max_packets: int, trace_width: int = 0) -> Array:
    """Make a workspace of n ticks: one vector, since numba takes 0.04 us for every array passed.

    `bounds` are (2, k); `trace_width` values of a trace follow the parameters.
    """
    k = bounds.shape[1]
    width = _HEADER + STATE_WIDTH + len(REPORT) + len(FLAGS) + 2 * k - (-k // 2)
    width += n * FAST_WIDTH + max_packets * PACKET_WIDTH + WINDOW_HEIGHT * count_columns(n)
    workspace = np.zeros(width + PARAMS_WIDTH + trace_width)
    workspace[:_HEADER] = n, k, max_packets
    _split_workspace(workspace)[1][:] = bounds
    return workspace


@jit
def split_workspace(workspace: Vector) -> tuple[EpisodeArrays, Matrix, Matrix]:
    """Split a workspace into its parts.

    Args:
        workspace: Vector that `_make_workspace` made.

    Returns:
        The episode's arrays, bounds of the observation, window.
    """
    sizes = read(workspace, SIZES)
    n, k, max_packets = int(sizes.n), int(sizes.n_entries), int(sizes.max_packets)
    report = _HEADER + STATE_WIDTH
    flags = report + len(REPORT)
    bounds = flags + len(FLAGS)
    window = bounds + 2 * k
    rows = window + WINDOW_HEIGHT * count_columns(n)
    packets = rows + n * FAST_WIDTH
    obs = packets + max_packets * PACKET_WIDTH
    row = EpisodeArrays(
        workspace[obs - (-k // 2) :], workspace[_HEADER:report],
        as_int64(workspace, flags, len(FLAGS)), as_float32(workspace, obs, k),
        as_matrix(workspace, rows, n, FAST_WIDTH),
        as_matrix(workspace, packets, max_packets, PACKET_WIDTH), workspace[report:flags],
    )  # fmt: skip
    return (
        row,
        as_matrix(workspace, bounds, 2, k),
        as_matrix(workspace, window, WINDOW_HEIGHT, count_columns(n)),
    )


_split_workspace = as_python(split_workspace)
_VIEW_NAMES = (
    "_row", "_params", "_state", "_switches", "_obs", "rows", "packets", "_report", "_bounds",
    "_window", "_read_report", "_copy_observation",
)  # fmt: skip


class WorkspaceMixin:
    """An environment of one car, whose arrays are parts of `_workspace`.

    `rows` and `packets` are the newest record's; `delivered` of the latter are there.
    """

    config: Any  # `EnvConfig`
    control_period: int
    _workspace: Array | None = None

    def _allocate(self, width: int) -> None:
        """Allocate a workspace for `width` parameters with a trace, if that is another number."""
        if self._workspace is None or len(self._params) != width:
            config, n = self.config, self.control_period
            sizes = config.max_packets, width - PARAMS_WIDTH
            self._workspace = _make_workspace(n, config.bounds, *sizes)
            self._bind_views()

    def _bind_views(self) -> None:
        """Bind the workspace's parts, and the calls that read them in every step."""
        self._row, self._bounds, self._window = _split_workspace(self._workspace)
        self._params, self._state, self._switches, self._obs, *record = self._row
        self.rows, self.packets, self._report = record
        self._read_report, self._copy_observation = self._report.tolist, self._obs.copy

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if name not in _VIEW_NAMES}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._bind_views()

    @property
    def delivered(self) -> int:
        """Number of packets of the newest record."""
        return int(self._report[REPORT.packets])


class EpisodeStart(NamedTuple):
    """The packed start of an episode; of several, arrays have an axis more, the first."""

    params: Vector  # as in `EpisodeArrays`, but for the draws
    low: Vector  # (len(Draws),), the ranges that it draws from
    high: Vector
    switches: Vector
    motion: Vector  # (len(Motion),), NaN: standing on the road at the drawn speed
