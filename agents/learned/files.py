"""A learned policy as one file: weights as safetensors, whose metadata hold the card.

Reading it runs no code: safetensors are numbers, the card is JSON.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors.numpy import save

from ...envs.arguments import describe_unknown
from ...envs.backend.files import write_atomic
from ...envs.documents import from_json
from ...estimators.learned.network import Network
from ...estimators.learned.network_file import (
    NO_MEMORY,
    build_network,
    collect_tensors,
    describe_network,
    parse_json_object,
    read_tensors,
)
from ...estimators.learned.network_file import SUFFIX as SUFFIX
from .card import Card

FORMAT = 2
"""Counts up when an older sideslip could not read, or would misread, a newer file: since 2 a
network may have memory and more activations."""
ZIP = ".zip"  # of stable-baselines3, which `agents.training.zips` reads
FOLDER = Path(__file__).resolve().with_name("policies")


@dataclass(frozen=True)
class Policy:
    """A network and its card.

    Attributes:
        name: Name of the file without its ending.
        network: Network that computes the action.
        card: Card of its training.
    """

    name: str
    network: Network
    card: Card

    @property
    def reads(self) -> npt.NDArray[np.bool_]:
        """Whether the network reads each entry of the card's observation, shape (inputs,)."""
        return self.network.reads

    @property
    def salt(self) -> str:
        """Hexadecimal hash of the network, from which its test seeds are made."""
        digest = hashlib.sha256()
        for name, values in collect_tensors(self.network).items():
            digest.update(name.encode() + values.tobytes())
        return digest.hexdigest()[:16]


def list_shipped() -> list[str]:
    """List the names of the policies that come with the package."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def is_policy(name: str) -> bool:
    """Return whether a name is a shipped policy's, or a path with a policy's ending.

    Args:
        name: Name or path.

    Returns:
        True for either of them.
    """
    return name.endswith(SUFFIX) or name in list_shipped()


def hash_policy(name: str) -> str:
    """Compute the hash of a policy's file, "" for a name that is no policy's.

    Args:
        name: Shipped name or path.

    Returns:
        SHA-256 in hexadecimal digits.
    """
    path = FOLDER / f"{name}{SUFFIX}" if name in list_shipped() else Path(name)
    exists = is_policy(name) and path.is_file()
    return hashlib.sha256(path.read_bytes()).hexdigest() if exists else ""


def save_policy(path: str | Path, network: Network, card: Card) -> None:
    """Write a policy's file; a save that is stopped leaves an older file unchanged.

    Args:
        path: Path that ends in `.safetensors`.
        network: Network to write.
        card: Card of its training.

    Raises:
        ValueError: The ending is another, or the card's observation has another width than the
            network's input.
    """
    target = Path(path)
    if target.suffix != SUFFIX:
        raise ValueError(f"a policy's file is NAME{SUFFIX}, got {target}")
    if len(card.observation) != network.inputs:
        raise ValueError(
            f"the card's observation has {len(card.observation)} entries, "
            f"the network takes {network.inputs}"
        )
    metadata = {"format": str(FORMAT), "card": card.to_json(network=describe_network(network))}
    write_atomic(target, save(collect_tensors(network), metadata))


def load_policy(path: str | Path) -> Policy:
    """Load a policy from its file, or a shipped one by its name.

    Args:
        path: Path or shipped name.

    Returns:
        Policy with its network and card.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no policy, is cut short, is larger than `MAX_BYTES` or has another
            format, or its card and tensors do not fit together.
    """
    file = _find_file(path)
    tensors, metadata = read_tensors(file, "policy")
    try:
        fields = _read_card_fields(metadata)
        observation = fields.get("observation")
        if not isinstance(observation, list):
            raise ValueError(f"the card's observation is a list, got {observation!r}")
        network = build_network(fields.pop("network", None), len(observation), tensors)
        return Policy(file.stem, network, from_json(Card, fields, "the card"))
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def _find_file(path: str | Path) -> Path:
    name = str(path)
    if name in list_shipped():
        return FOLDER / f"{name}{SUFFIX}"
    file = Path(path)
    if not file.is_file():
        if file.is_dir():
            raise FileNotFoundError(f"policy {name} is a folder")
        raise FileNotFoundError(
            f"there is no such file and {describe_unknown('policy', [name], list_shipped())}"
        )
    return file


def _read_card_fields(metadata: dict[str, str]) -> dict[str, Any]:
    """The card's JSON object with the architecture, checked as far as the format goes."""
    if not {"format", "card"} <= metadata.keys():
        raise ValueError("safetensors without a card: this is not a policy of sideslip")
    known = [str(version) for version in range(1, FORMAT + 1)]
    if metadata["format"] not in known:
        raise ValueError(
            f"the card has format {metadata['format'][:20]}, this sideslip reads "
            f"{' and '.join(known)}: another sideslip made it"
        )
    fields = parse_json_object(metadata["card"])
    if metadata["format"] == "1" and isinstance(fields.get("network"), dict):
        fields["network"] |= NO_MEMORY  # it has none
    return fields
