"""A learned correction as one file: a network as safetensors, whose metadata hold the card."""

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from safetensors.numpy import save

from ...envs.backend.files import write_whole
from ...envs.documents import made_of
from ..filters import FILTERS
from .network import Network
from .network_file import ENDING, architecture_of, json_object, network_of, read_tensors, tensors_of

FORMAT = "1"
"""Counts up where what a network reads (`kernel`) or its card changes."""
FOLDER = Path(__file__).resolve().with_name("corrections")
FAST_INPUTS = (
    "gyro", "accel_y", "accel_x", "roll_rate", "wheel_left", "steer", "torque_left", "torque_right"
)  # fmt: skip
LAGS = (0, 1, 2, 4, 6, 9, 13, 17, 22, 27, 33, 40)
"""The frames that are read, in paces back; twelve, since layers take inputs by fours."""


@dataclass(frozen=True, kw_only=True)
class CorrectionCard:
    """What a correction reads and how it was made; JSON types only.

    base, base_options: the filter, a name of `FILTERS` with gains "covariance", and its options.
    states: of the filter, which the network reads beside the standard deviation of its beta.
    scenarios, seed, command, cpu_seconds, sideslip: of the training. temperature: the factor on the
    deviation found on held-out seeds; evaluation: what was measured on others.

    Raises ValueError for another base, or states without beta.
    """

    base: str
    states: tuple[str, ...]
    base_options: dict[str, Any] = field(default_factory=dict)
    scenarios: tuple[str, ...] = ()
    seed: int = 0
    command: str = ""
    cpu_seconds: float = 0.0
    temperature: float = 1.0
    evaluation: dict[str, float] = field(default_factory=dict)
    sideslip: str = ""

    def __post_init__(self) -> None:
        known = [name for name, row in FILTERS.items() if row.gains == "covariance"]
        if self.base not in known:
            raise ValueError(f"a correction's base is {', '.join(known)}, got {self.base!r}")
        if not isinstance(self.states, list | tuple) or "beta" not in self.states:
            raise ValueError(f"a correction reads its filter's beta, got states {self.states!r}")
        told = sorted({"vehicle", "sensors", "dt", "speed"} & self.base_options.keys())
        if told:
            raise ValueError(f"base_options hold what the env tells a filter: {', '.join(told)}")

    @property
    def inputs(self) -> int:
        """Numbers that the network takes, frames with: a_y / v - gyro, the fast inputs, states, the
        deviation of beta, and the filter's mass."""
        return (len(FAST_INPUTS) + len(self.states) + 3) * len(LAGS)


@dataclass(frozen=True)
class Correction:
    """A network and its card. The network's two outputs are what is added to beta (rad) and the
    logarithm of the standard deviation of the sum (rad); ValueError for another network."""

    card: CorrectionCard
    network: Network

    def __post_init__(self) -> None:
        net, inputs = self.network, self.card.inputs
        found = net.inputs, net.width, net.memory, net.activation, net.output, net.clip is None
        if found != (inputs, 2, 0, "relu", "linear", False) or any(n % 4 for n in net.hidden):
            raise ValueError(
                f"a correction's network takes {inputs} numbers and gives 2, is relu with layers "
                f"of whole fours, clips and has no memory; this is {found} with {net.hidden}"
            )


def shipped() -> list[str]:
    """The names of the corrections that come with the package: their filters'."""
    return sorted(path.stem for path in FOLDER.glob(f"*{ENDING}"))


def save_correction(path: str | Path, correction: Correction) -> None:
    """Write the whole file or none; ValueError for another ending than `.safetensors`."""
    if Path(path).suffix != ENDING:
        raise ValueError(f"a correction's file is NAME{ENDING}, got {path}")
    content = asdict(correction.card) | {"network": architecture_of(correction.network)}
    metadata = {"format": FORMAT, "correction": json.dumps(content, allow_nan=False)}
    write_whole(path, save(tensors_of(correction.network), metadata))


def load_correction(path: str | Path) -> Correction:
    """A correction from its file, or a shipped one by its filter's name.

    Raises FileNotFoundError where there is none; ValueError for a file that is no correction, is
    cut short, has another format, or whose card and tensors do not fit together.
    """
    found = FOLDER / f"{path}{ENDING}" if str(path) in shipped() else Path(path)
    if not found.is_file():
        names = ", ".join(shipped()) or "none"
        raise FileNotFoundError(f"there is no correction {path}; shipped ones: {names}")
    tensors, metadata = read_tensors(found, "correction")
    try:
        if metadata.get("format") != FORMAT or "correction" not in metadata:
            raise ValueError(f"safetensors without the card of a correction of format {FORMAT}")
        content = json_object(metadata["correction"])
        architecture = content.pop("network", None)
        if content.keys() != {each.name for each in fields(CorrectionCard)}:
            raise ValueError(f"the card has other fields than a correction's: {sorted(content)}")
        card = made_of(CorrectionCard, content, "the card")
        return Correction(card, network_of(architecture, card.inputs, tensors))
    except ValueError as error:
        raise ValueError(f"{found}: {error}") from None
