"""A learned correction as one file: a network as safetensors, whose metadata hold the card."""

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from safetensors.numpy import save

from ...envs.io import from_json, write_atomic
from ..filters import FILTERS
from .network import SUFFIX, Network, build_network, parse_json_object, read_tensors

FORMAT = "1"
"""Counts up where what a network reads (`correction`) or its card changes."""
FOLDER = Path(__file__).resolve().with_name("corrections")
FAST_INPUTS = (
    "gyro", "accel_y", "accel_x", "roll_rate", "wheel_left", "steer", "torque_left", "torque_right"
)  # fmt: skip
LAGS = (0, 1, 2, 4, 6, 9, 13, 17, 22, 27, 33, 40)
"""The frames that are read, in paces back; twelve, since layers take inputs by fours."""


@dataclass(frozen=True, kw_only=True)
class CorrectionCard:
    """The inputs of a correction and how it was made; JSON types only.

    ValueError says that the base is another, or that beta is not among the states.
    """

    base: str  # the filter, a name of `FILTERS` with gains "covariance"
    states: tuple[str, ...]  # of the filter, which the network reads beside the deviation of beta
    base_options: dict[str, Any] = field(default_factory=dict)  # of the filter
    scenarios: tuple[str, ...] = ()  # of the training
    seed: int = 0  # of the training
    command: str = ""  # of the training
    cpu_seconds: float = 0.0  # of the training
    temperature: float = 1.0  # factor on the deviation, from held-out seeds
    evaluation: dict[str, float] = field(default_factory=dict)  # measured on other seeds
    sideslip: str = ""  # version of the package in the training

    def __post_init__(self) -> None:
        allowed = [name for name, row in FILTERS.items() if row.gains == "covariance"]
        if self.base not in allowed:
            raise ValueError(f"a correction's base is {', '.join(allowed)}, got {self.base!r}")
        if not isinstance(self.states, list | tuple) or "beta" not in self.states:
            raise ValueError(f"a correction reads its filter's beta, got states {self.states!r}")
        taken = sorted({"vehicle", "sensors", "dt", "speed"} & self.base_options.keys())
        if taken:
            raise ValueError(f"base_options hold what the env tells a filter: {', '.join(taken)}")

    @property
    def inputs(self) -> int:
        """Number of the network's inputs."""
        # of a frame: a_y / v - gyro, fast inputs, states, deviation of beta, the filter's mass
        return (len(FAST_INPUTS) + len(self.states) + 3) * len(LAGS)


@dataclass(frozen=True)
class Correction:
    """A network and its card; ValueError says that the network does not fit.

    The network's two outputs are what is added to beta (rad) and the logarithm of the standard
    deviation of the sum (rad).
    """

    card: CorrectionCard
    network: Network

    def __post_init__(self) -> None:
        net, inputs = self.network, self.card.inputs
        actual = net.inputs, net.width, net.memory, net.activation, net.output, net.clip is None
        if actual != (inputs, 2, 0, "relu", "linear", False) or any(n % 4 for n in net.hidden):
            raise ValueError(
                f"a correction's network takes {inputs} numbers and gives 2, is relu with layers "
                f"of whole fours, clips and has no memory; this is {actual} with {net.hidden}"
            )


def list_shipped() -> list[str]:
    """List the names of the corrections that come with the package: their filters'."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def save_correction(path: str | Path, correction: Correction) -> None:
    """Write the whole file of a correction or none.

    Args:
        path: File that ends in `.safetensors`.
        correction: Network and card.

    Raises:
        ValueError: The file has another ending.
    """
    if Path(path).suffix != SUFFIX:
        raise ValueError(f"a correction's file is NAME{SUFFIX}, got {path}")
    content = asdict(correction.card) | {"network": correction.network.description}
    metadata = {"format": FORMAT, "correction": json.dumps(content, allow_nan=False)}
    write_atomic(path, save(correction.network.tensors, metadata))


def load_correction(path: str | Path) -> Correction:
    """Load a correction from its file, or a shipped one by its filter's name.

    Args:
        path: File, or name of `list_shipped`.

    Returns:
        Network and card.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no correction, is cut short, has another format, or its card and
            tensors do not fit together.
    """
    file = FOLDER / f"{path}{SUFFIX}" if str(path) in list_shipped() else Path(path)
    if not file.is_file():
        names = ", ".join(list_shipped()) or "none"
        raise FileNotFoundError(f"there is no correction {path}; shipped ones: {names}")
    tensors, metadata = read_tensors(file, "correction")
    try:
        if metadata.get("format") != FORMAT or "correction" not in metadata:
            raise ValueError(f"safetensors without the card of a correction of format {FORMAT}")
        content = parse_json_object(metadata["correction"])
        architecture = content.pop("network", None)
        if content.keys() != {card_field.name for card_field in fields(CorrectionCard)}:
            raise ValueError(f"the card has other fields than a correction's: {sorted(content)}")
        card = from_json(CorrectionCard, content, "the card")
        return Correction(card, build_network(architecture, card.inputs, tensors))
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
