"""A correction's file: written whole, read without running code, refused where it is damaged."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from sideslip.estimators.learned.correction_file import (
    Correction,
    CorrectionCard,
    list_shipped,
    load_correction,
    save_correction,
)
from tests.estimators.learned.test_correction import correction


def test_what_is_saved_is_what_is_loaded(tmp_path: Path) -> None:
    written = correction()
    save_correction(tmp_path / "own.safetensors", written)
    found = load_correction(tmp_path / "own.safetensors")
    assert json.loads(json.dumps(dataclasses.asdict(found.card))) == json.loads(
        json.dumps(dataclasses.asdict(written.card))
    )
    x = np.random.default_rng(0).normal(size=(9, written.card.inputs))
    assert np.array_equal(found.network(x), written.network(x))


@pytest.mark.parametrize("name", list_shipped())
def test_a_shipped_correction_has_a_card_that_says_how_it_was_made(name: str) -> None:
    card = load_correction(name).card
    assert card.base == name and f"train-estimator {name}" in card.command
    assert card.evaluation["rmse"] < card.evaluation["filter_rmse"]
    assert 0.93 < card.evaluation["coverage"] < 0.97


def changed(path: Path, card: Any = None, **tensors: Any) -> None:
    """Write the file with other fields of its card (None: without one), or other tensors."""
    with safe_open(path, "numpy") as file:
        metadata = dict(file.metadata())
        numbers = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    fields = json.loads(metadata["correction"]) | (card or {})
    metadata["correction"] = json.dumps({k: v for k, v in fields.items() if v is not None})
    save_file(numbers | tensors, path, metadata)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda p: p.write_bytes(p.read_bytes()[:-40]), "cut short"),
        (lambda p: p.write_bytes(b"no tensors"), "no safetensors file"),
        (lambda p: save_file({}, p, {"card": "{}"}), "without the card of a correction"),
        (lambda p: save_file({}, p, {"format": "0", "correction": "{}"}), "of format 1"),
        (lambda p: changed(p, {"seed": None}), "other fields than a correction's"),
        (lambda p: changed(p, {"base": "magic"}), "base is course-kf, .*got 'magic'"),
        (lambda p: changed(p, {"base": "multirate-kf"}), "got 'multirate-kf'"),
        (lambda p: changed(p, {"states": ["gamma"]}), "reads its filter's beta"),
        (lambda p: changed(p, {"states": ["beta", "gamma", "F_d"]}), "tensor .* has shape"),
        (lambda p: changed(p, weight_0=np.zeros((3, 3), np.float32)), "tensor weight_0"),
        (lambda p: changed(p, more=np.zeros(2, np.float32)), "unexpected ones: .*more"),
        (lambda p: changed(p, bias_0=np.full(16, np.nan, np.float32)), "16 are not finite"),
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path: Path, damage: Any, said: str) -> None:
    path = tmp_path / "own.safetensors"
    save_correction(path, correction())
    damage(path)
    with pytest.raises(ValueError, match=f"(?s)own.safetensors.*{said}"):
        load_correction(path)


def test_there_is_a_file_or_a_shipped_name(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no correction moon; shipped ones"):
        load_correction("moon")
    with pytest.raises(ValueError, match=r"a correction's file is NAME.safetensors"):
        save_correction(tmp_path / "own.zip", correction())


def test_another_network_is_no_correction() -> None:
    made = correction()
    for other in ({"activation": "tanh"}, {"clip": None}, {"output": "tanh"}):
        with pytest.raises(ValueError, match="a correction's network takes"):
            Correction(made.card, dataclasses.replace(made.network, **other))
    with pytest.raises(ValueError, match="a correction's network takes"):
        Correction(CorrectionCard(base="joint", states=("beta",)), made.network)
