"""The workspace of one car: one vector that holds the arrays of its episode.

It is one, since numba takes 0.04 us for every array passed.
"""

from typing import NamedTuple

import numpy as np

from ..numerics.jit import as_python, jit
from ..numerics.packed import as_float32, as_int64, as_matrix, make_offsets, read
from ..numerics.primitives import Scalar, Vector
from ..record import FAST_WIDTH, PACKET_WIDTH, Array
from ..task import REPORT
from .config import EnvConfig
from .layout import FLAGS, PARAMS_WIDTH, STATE_WIDTH, EpisodeArrays
from .window import WINDOW_HEIGHT, count_columns


class _WorkspaceSizes(NamedTuple):
    """Sizes at the beginning of a workspace."""

    n: Scalar  # ticks a step
    n_entries: Scalar  # of an observation
    max_packets: Scalar  # packets of a step


SIZES, _HEADER = make_offsets(_WorkspaceSizes)


def _make_workspace(config: EnvConfig, trace_width: int = 0) -> Array:
    """Make a workspace, in which `trace_width` values of a trace follow the parameters."""
    n, k, max_packets = int(config.control_period), len(config.layout), config.max_packets
    width = _HEADER + STATE_WIDTH + len(REPORT) + len(FLAGS) + 2 * k - (-k // 2)
    width += n * FAST_WIDTH + max_packets * PACKET_WIDTH + WINDOW_HEIGHT * count_columns(n)
    workspace = np.zeros(width + PARAMS_WIDTH + trace_width)
    workspace[:_HEADER] = n, k, max_packets
    _split_workspace(workspace).bounds[:] = config.bounds
    return workspace


@jit
def split_workspace(workspace: Vector) -> EpisodeArrays:
    """Split a workspace into its parts.

    Args:
        workspace: Vector of `_make_workspace`.

    Returns:
        The episode's arrays.
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
    return EpisodeArrays(
        workspace[obs - (-k // 2) :], workspace[_HEADER:report],
        as_int64(workspace, flags, len(FLAGS)), as_float32(workspace, obs, k),
        as_matrix(workspace, rows, n, FAST_WIDTH),
        as_matrix(workspace, packets, max_packets, PACKET_WIDTH), workspace[report:flags],
        as_matrix(workspace, bounds, 2, k),
        as_matrix(workspace, window, WINDOW_HEIGHT, count_columns(n)),
    )  # fmt: skip


_split_workspace = as_python(split_workspace)


class Workspace:
    """The arrays of one car's episode, which are parts of one `vector`.

    Args:
        config: Config of the environment.

    Attributes:
        vector: The vector; a copy of it is a copy of the episode.
        row: Its parts.
        read_report: Function that lists the report's numbers.
        copy_observation: Function that copies the observation.
    """

    def __init__(self, config: EnvConfig) -> None:
        self._config = config
        self._bind(_make_workspace(config))

    def allocate(self, width: int) -> None:
        """Make room for parameters with a trace, and lose all numbers, if the room is another.

        Args:
            width: Number of the parameters.
        """
        if len(self.row.p) != width:
            self._bind(_make_workspace(self._config, width - PARAMS_WIDTH))

    def _bind(self, vector: Array) -> None:
        """Bind the vector's parts, and the calls that read them in every step."""
        self.vector, self.row = vector, _split_workspace(vector)
        self.read_report, self.copy_observation = self.row.report.tolist, self.row.obs.copy

    def __getstate__(self) -> tuple[EnvConfig, Array]:
        return self._config, self.vector

    def __setstate__(self, state: tuple[EnvConfig, Array]) -> None:
        self._config, vector = state
        self._bind(vector)
