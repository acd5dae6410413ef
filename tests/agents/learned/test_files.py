"""A policy's file: what is read is what was saved, and every bad file is refused by name."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from sideslip.agents.learned.policy import FORMAT, Card, list_shipped, load_policy, save_policy
from sideslip.estimators.learned.network import Network

pytestmark = pytest.mark.plain
CARD = Card(
    "sideslip/YawVision-v0",
    (("gyro", "rad/s"), ("camera_psi", "rad"), ("beta_ref", "rad")),
    10,
    "zero-slip",
    env_options={"scenario": {"base": "gust", "speed": 12.0}},
    algorithm="ppo",
    command="sideslip train --algo ppo",
    seeds={"training": [0, 1]},
    steps=1000,
    cpu_seconds=1.5,
)


def a_network(seed: int = 0, inputs: int = 3, **options: Any) -> Network:
    rng = np.random.default_rng(seed)
    sizes = (inputs, 8, 5, 1)
    pairs = list(pairwise(sizes))
    weights = [rng.normal(size=(out, into)) for into, out in pairs]
    biases = [rng.normal(size=out) for _, out in pairs]
    options = {"clip": 10.0} | options
    return Network(
        rng.normal(size=inputs), rng.uniform(0.5, 2.0, inputs), weights, biases, **options
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.safetensors"
    save_policy(path, a_network(), CARD)
    return path


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("output", ["linear", "tanh"])
@pytest.mark.parametrize("clip", [None, 5.0])
def test_what_is_read_is_what_was_saved(
    tmp_path: Path, activation: str, output: str, clip: float | None
) -> None:
    path = tmp_path / "mine.safetensors"
    network = a_network(activation=activation, output=output, clip=clip)
    save_policy(path, network, CARD)
    policy = load_policy(str(path))
    assert policy.name == "mine" and policy.card == CARD
    x = np.random.default_rng(1).normal(size=(50, 3)) * 10.0
    assert np.array_equal(policy.network(x), network(x))
    assert policy.network.hidden == (8, 5) and policy.network.width == 1
    assert [each.name for each in tmp_path.iterdir()] == ["mine.safetensors"]


def test_a_network_is_its_formula() -> None:
    network = a_network()
    for x in np.random.default_rng(2).normal(size=(5, 3)) * 20.0:
        z = [max(-10.0, min(10.0, each)) for each in (x - network.mean) * network.scale]
        for layer, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
            z = [sum(W[i, j] * z[j] for j in range(len(z))) + b[i] for i in range(len(b))]
            z = [np.tanh(each) for each in z] if layer < 2 else z
        assert network(x[None])[0] == pytest.approx(z, rel=1e-12)


def test_the_salt_is_of_the_weights_alone(file: Path) -> None:
    first = load_policy(file).salt
    save_policy(file, a_network(), replace(CARD, evaluation={"cost": 1.0}))
    assert load_policy(file).salt == first and int(first, 16) >= 0
    save_policy(file, a_network(1), CARD)
    assert load_policy(file).salt != first


@pytest.mark.compiled  # their filters' gains are found by thousands of ticks
@pytest.mark.parametrize("name", list_shipped())
def test_shipped_policies_can_be_read(name: str) -> None:
    policy = load_policy(name)
    card = policy.card
    assert policy.name == name and card.command and card.steps > 0 and card.cpu_seconds > 0.0
    again = Card.from_env_id(card.env_id, card.env_options, card.estimator, card.estimator_options)
    assert again.observation == card.observation and again.reference == card.reference
    assert card.evaluation["salt"] == policy.salt
    assert {"none", "lqr on exact-kf", name} <= card.evaluation["cost"].keys()


def test_a_kill_during_a_save_keeps_the_old_file(file: Path) -> None:
    """Killed where the new file is written but not yet in the old one's place."""
    before = file.read_bytes()
    code = (
        "import os, signal, sys\n"
        "from sideslip.agents.learned.policy import load_policy, save_policy\n"
        "policy = load_policy(sys.argv[1])\n"
        "os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)\n"
        "save_policy(sys.argv[1], policy.network.select_inputs(policy.reads), policy.card)\n"
    )
    command = [sys.executable, "-c", code, str(file)]
    env = os.environ | {"PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert file.read_bytes() == before
    assert load_policy(file).card == CARD
    save_policy(file, a_network(1), CARD)  # what the kill left behind is in nobody's way
    assert load_policy(file).network.mean[0] == a_network(1).mean[0]


def test_a_failed_save_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_policy(tmp_path / "mine.safetensors", a_network(), CARD)
    assert list(tmp_path.iterdir()) == []


def edited(
    path: Path, edit: Callable[[dict[str, Any], dict[str, Any], dict[str, Any]], None]
) -> None:
    """Rewrite a file after edit(tensors, metadata, card)."""
    with safe_open(path, "numpy") as file:
        metadata = dict(file.metadata())
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    card = json.loads(metadata["card"])
    edit(tensors, metadata, card)
    if "card" in metadata and metadata["card"] != "no json":
        metadata["card"] = json.dumps(card)
    save_file(tensors, path, metadata)


BAD: dict[str, tuple[Callable[[Any, Any, Any], Any], str]] = {
    "no card": (lambda t, m, c: m.pop("card"), "without a card"),
    "newer": (lambda t, m, c: m.update(format=str(FORMAT + 1)), "another sideslip made it"),
    "no version": (lambda t, m, c: m.update(format="0"), "format 0, this sideslip reads 1 and 2"),
    "not of its version": (lambda t, m, c: c["network"].pop("cells"), "network holds hidden"),
    "strange format": (lambda t, m, c: m.update(format="two"), "format two"),
    "no JSON": (lambda t, m, c: m.update(card="no json"), "card is no JSON"),
    "missing tensor": (lambda t, m, c: t.pop("weight_1"), r"missing tensors: \['weight_1'\]"),
    "extra tensor": (lambda t, m, c: t.update(more=t["mean"]), r"unexpected ones: \['more'\]"),
    "wrong shape": (
        lambda t, m, c: t.update(weight_0=np.zeros((8, 4), np.float32)),
        r"weight_0 has shape \(8, 4\).*card has \(8, 3\)",
    ),
    "wrong type": (
        lambda t, m, c: t.update(bias_0=np.zeros(8)),
        "bias_0 has shape .* of float64.*of float32",
    ),
    "NaN": (
        lambda t, m, c: t["weight_1"].__setitem__((0, 0), np.nan),
        "weights of layer 1: 1 are not finite",
    ),
    "infinite bias": (lambda t, m, c: t["bias_2"].fill(np.inf), "biases of layer 2: 1 are not"),
    "NaN mean": (lambda t, m, c: t["mean"].fill(np.nan), "mean: 3 are not finite"),
    "negative scale": (lambda t, m, c: t["scale"].fill(-1.0), "scale is below zero"),
    "activation": (lambda t, m, c: c["network"].update(activation="gelu"), "activation 'gelu'"),
    "output": (lambda t, m, c: c["network"].update(output="softmax"), "output 'softmax'"),
    "clip": (lambda t, m, c: c["network"].update(clip=-1.0), "clip is above zero"),
    "clip of text": (lambda t, m, c: c["network"].update(clip="10"), "clip is above zero"),
    "sizes": (lambda t, m, c: c["network"].update(hidden=[8, -5]), "positive integers"),
    "no sizes": (lambda t, m, c: c["network"].update(hidden=None), "positive integers"),
    "history": (lambda t, m, c: c["network"].update(history=2.0), "positive integers"),
    "longer history": (
        lambda t, m, c: c["network"].update(history=10**12),
        r"weight_0 has shape \(8, 3\).*card has \(8, 3000000000000\)",
    ),
    "cells": (lambda t, m, c: c["network"].update(cells=[["rnn", 3]]), "pairs of gru, lstm and"),
    "cell of no size": (lambda t, m, c: c["network"].update(cells=[["gru", -3]]), "pairs of gru"),
    "cell of text": (lambda t, m, c: c["network"].update(cells="gru"), "pairs of gru"),
    "traces without times": (
        lambda t, m, c: c["network"].update(cells=[["traces", 5, 2]]),
        "or traces with units, how many are bent, and times",
    ),
    "traces of text": (
        lambda t, m, c: c["network"].update(cells=[["traces", 5, 2, ["3"]]]),
        "or traces with units",
    ),
    "no traces' tensors": (
        lambda t, m, c: c["network"].update(cells=[["traces", 5, 2, [3, 10.0]]]),
        r"missing tensors: \['cell_0_bias_in', 'cell_0_weight_in'\]",
    ),
    "no cell's tensors": (
        lambda t, m, c: c["network"].update(cells=[["gru", 3]]),
        r"missing tensors: \['cell_0_bias_in'",
    ),
    "no network": (lambda t, m, c: c.pop("network"), "card's network holds hidden"),
    "lacks": (lambda t, m, c: c.pop("env_id"), "missing env_id"),
    "unknown field": (lambda t, m, c: c.update(colour="red"), "the card: unknown colour"),
    "kind": (lambda t, m, c: c.update(steps="many"), "steps is 'many', not int"),
    "entry": (
        lambda t, m, c: c.update(observation=[["gyro"], ["a", "b"], ["c", "d"]]),
        r"list of \(name, unit\)",
    ),
    "twice": (lambda t, m, c: c.update(observation=[["gyro", "rad/s"]] * 3), "an entry twice"),
    "no observation": (lambda t, m, c: c.update(observation=None), "observation is a list"),
    "narrow": (lambda t, m, c: c["observation"].pop(), r"mean has shape \(3,\)"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_says_what_is_wrong(file: Path, name: str) -> None:
    edit, said = BAD[name]
    edited(file, edit)
    with pytest.raises(ValueError, match=said) as told:
        load_policy(file)
    assert str(file) in str(told.value)


def of_the_first_format(tensors: Any, metadata: Any, card: Any) -> None:
    metadata["format"] = "1"
    del card["network"]["history"], card["network"]["cells"]


def test_a_file_of_the_first_format_is_a_network_without_memory(file: Path) -> None:
    network = load_policy(file).network
    edited(file, of_the_first_format)
    again = load_policy(file).network
    x = np.random.default_rng(1).normal(size=(50, 3))
    assert np.array_equal(again(x), network(x)) and again.memory == 0


def test_a_file_too_large_is_not_opened(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sideslip.estimators.learned.network.MAX_BYTES", 1000)
    with pytest.raises(ValueError, match=r"bytes, a policy has at most 1000"):
        load_policy(file)


def test_a_card_nested_without_end_is_refused(file: Path) -> None:
    with safe_open(file, "numpy") as read:
        metadata = dict(read.metadata())
        tensors = {name: read.get_tensor(name) for name in read.keys()}  # noqa: SIM118
    save_file(tensors, file, metadata | {"card": "[" * 100_000})
    with pytest.raises(ValueError, match="card is no JSON"):
        load_policy(file)


@pytest.mark.parametrize("length", [0, 4, 8, 200, 1000])
def test_a_file_cut_short_is_refused(file: Path, length: int) -> None:
    whole = file.read_bytes()
    assert len(whole) > length
    file.write_bytes(whole[:length])
    with pytest.raises(ValueError, match=r"mine\.safetensors is no safetensors file, or is cut"):
        load_policy(file)


def test_other_files_and_names_are_refused(tmp_path: Path) -> None:
    other = tmp_path / "zip.safetensors"
    other.write_bytes(b"PK\x03\x04" + bytes(300))
    with pytest.raises(ValueError, match="is no safetensors file"):
        load_policy(other)
    with pytest.raises(FileNotFoundError, match="unknown policy 'nobody'; known: distill-car-"):
        load_policy("nobody")
    with pytest.raises(FileNotFoundError, match="is a folder"):
        load_policy(tmp_path)


def test_what_cannot_be_saved_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"NAME\.safetensors"):
        save_policy(tmp_path / "mine.zip", a_network(), CARD)
    with pytest.raises(ValueError, match="has 3 entries, the network takes 4"):
        save_policy(tmp_path / "mine.safetensors", a_network(inputs=4), CARD)
    with pytest.raises(ValueError, match="what JSON has not"):
        replace(CARD, evaluation={"cost": float("nan")})
    with pytest.raises(ValueError, match="cpu_seconds is '2', not float"):
        replace(CARD, cpu_seconds="2")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"weights": []}, "got 0 weights"),
        ({"mean": np.zeros((1, 3))}, r"\(inputs,\)"),
        ({"biases": [np.zeros(9), np.zeros(5), np.zeros(1)]}, "layer 0 takes 3 inputs"),
        ({"activation": "gelu"}, "known: tanh, relu"),
        ({"clip": 0.0}, "clip is above zero"),
    ],
)
def test_a_network_that_does_not_fit_together(change: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        replace(a_network(), **change)
