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

from sideslip.agents.learned.network import Network
from sideslip.agents.learned.policy import FORMAT, Card, list_shipped, load_policy, save_policy

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
        "net = policy.network\n"
        "save_policy(sys.argv[1], net.select_inputs(net.reads), policy.card)\n"
    )
    command = [sys.executable, "-c", code, str(file)]
    env = os.environ | {"PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert file.read_bytes() == before
    assert load_policy(file).card == CARD
    save_policy(file, a_network(1), CARD)  # what the kill left behind is in nobody's way
    assert load_policy(file).network.mean[0] == a_network(1).mean[0]


def edited(path: Path, edit: Callable[[Any, Any, Any], Any]) -> None:
    """Rewrite a file after edit(tensors, metadata, card)."""
    with safe_open(path, "numpy") as file:
        metadata = dict(file.metadata())
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    text, card = metadata["card"], json.loads(metadata["card"])
    edit(tensors, metadata, card)
    if metadata.get("card") == text:
        metadata["card"] = json.dumps(card)
    save_file(tensors, path, metadata)


KIND, TYPE = (
    "values of another kind",
    "bias_0 holds 8 numbers of float64, not one or more of float32",
)
SHAPE = r"with 4 inputs, got \(3,\)"
MISSING_TRACES = "tensor 'cell_0_weight_in' is missing"
ENTRIES = [["gyro"], ["a", "b"], ["c", "d"]]
Edit = Callable[[Any, Any, Any], Any]  # of tensors, metadata and card
BAD: dict[str, tuple[Edit, str]] = {
    "no card": (lambda t, m, c: m.pop("card"), "without a card"),
    "newer": (lambda t, m, c: m.update(format=str(FORMAT + 1)), "another sideslip made it"),
    "no version": (lambda t, m, c: m.update(format="0"), "format 0, this sideslip reads 1 and 2"),
    "not of its version": (lambda t, m, c: c["network"].pop("cells"), "network holds action_width"),
    "strange format": (lambda t, m, c: m.update(format="two"), "format two"),
    "no JSON": (lambda t, m, c: m.update(card="no json"), "card is no JSON"),
    "nested without end": (lambda t, m, c: m.update(card="[" * 100_000), "card is no JSON"),
    "missing tensor": (lambda t, m, c: t.pop("weight_1"), "tensor 'weight_1' is missing"),
    "extra tensor": (lambda t, m, c: t.update(more=t["bias_0"]), "unexpected tensors: more"),
    "wrong shape": (lambda t, m, c: t.update(weight_0=np.zeros((8, 4), np.float32)), SHAPE),
    "wrong type": (lambda t, m, c: t.update(bias_0=np.zeros(8)), TYPE),
    "NaN": (lambda t, m, c: t["weight_1"].put(0, np.nan), "weight_1: 1 are not finite"),
    "infinite bias": (lambda t, m, c: t["bias_2"].fill(np.inf), "bias_2: 1 are not"),
    "NaN mean": (lambda t, m, c: t["mean"].fill(np.nan), "mean: 3 are not finite"),
    "negative scale": (lambda t, m, c: t["scale"].fill(-1.0), "scale is below zero"),
    "no network": (lambda t, m, c: c.pop("network"), "card's network holds action_width"),
    "lacks": (lambda t, m, c: c.pop("env_id"), "missing env_id"),
    "unknown field": (lambda t, m, c: c.update(colour="red"), "the card: unknown colour"),
    "kind": (lambda t, m, c: c.update(steps="many"), "steps is 'many', not int"),
    "entry": (lambda t, m, c: c.update(observation=ENTRIES), r"list of \(name, unit\)"),
    "twice": (lambda t, m, c: c.update(observation=[["gyro", "rad/s"]] * 3), "an entry twice"),
    "no observation": (lambda t, m, c: c.update(observation=None), "observation is None, not"),
    "narrow": (lambda t, m, c: c["observation"].pop(), "has 2 entries, the network takes 3"),
}
BAD_NETWORKS: dict[str, tuple[dict[str, Any], str]] = {
    "activation": ({"activation": "gelu"}, "activation 'gelu'"),
    "output": ({"output": "softmax"}, "output 'softmax'"),
    "clip": ({"clip": -1.0}, "clip is above zero"),
    "clip of text": ({"clip": "10"}, KIND),
    "sizes": ({"hidden": [8, -5]}, "the tensors are of another one"),
    "no sizes": ({"hidden": None}, KIND),
    "history": ({"history": 2.0}, "network holds .*got"),
    "longer history": ({"history": 10**12}, "3 inputs are not 10{12} frames"),
    "cells": ({"cells": [["rnn", 3]]}, "unknown cell 'rnn'; known: gru, lstm, traces"),
    "cell of no size": ({"cells": [["gru", -3]]}, "'cell_0_weight_in' is missing"),
    "cell of text": ({"cells": "gru"}, KIND),
    "no times": ({"cells": [["traces", 5, 2]]}, MISSING_TRACES),
    "times of text": ({"cells": [["traces", 5, 2, ["3"]]]}, MISSING_TRACES),
    "no traces": ({"cells": [["traces", 5, 2, [3, 10.0]]]}, MISSING_TRACES),
    "no cell": ({"cells": [["gru", 3]]}, "tensor 'cell_0_weight_in' is missing"),
}


@pytest.mark.parametrize("name", [*BAD, *BAD_NETWORKS])
def test_a_bad_file_says_what_is_wrong(file: Path, name: str) -> None:
    change, said = BAD_NETWORKS.get(name, ({}, ""))
    edit, said = BAD.get(name, (lambda t, m, c: c["network"].update(change), said))
    edited(file, edit)
    with pytest.raises(ValueError, match=said) as told:
        load_policy(file)
    assert str(file) in str(told.value)


def test_a_file_of_the_first_format_is_a_network_without_memory(file: Path) -> None:
    def change(tensors: Any, metadata: Any, card: Any) -> None:
        metadata["format"] = "1"
        del card["network"]["history"], card["network"]["cells"]

    network = load_policy(file).network
    edited(file, change)
    again = load_policy(file).network
    x = np.random.default_rng(1).normal(size=(50, 3))
    assert np.array_equal(again(x), network(x)) and again.memory == 0


def test_a_file_too_large_is_not_opened(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sideslip.agents.learned.policy.MAX_BYTES", 1000)
    with pytest.raises(ValueError, match=r"bytes, a policy has at most 1000"):
        load_policy(file)


@pytest.mark.parametrize("length", [0, 4, 8, 200, 1000])
def test_a_file_cut_short_is_refused(file: Path, length: int) -> None:
    whole = file.read_bytes()
    assert len(whole) > length
    file.write_bytes(whole[:length])
    with pytest.raises(ValueError, match=r"mine\.safetensors is no safetensors file, or is cut"):
        load_policy(file)


NAME = "mine.safetensors"
Call = Callable[[Path], Any]
REFUSALS: dict[str, tuple[Call, type[Exception]]] = {
    "is no safetensors file": (lambda path: load_policy(path / "zip.safetensors"), ValueError),
    "unknown policy 'nobody'; known: distill-car-": (
        lambda _: load_policy("nobody"),
        FileNotFoundError,
    ),
    "is a folder": (load_policy, FileNotFoundError),
    r"NAME\.safetensors": (lambda p: save_policy(p / "mine.zip", a_network(), CARD), ValueError),
    "has 3 entries, the network takes 4": (
        lambda path: save_policy(path / NAME, a_network(inputs=4), CARD),
        ValueError,
    ),
    "what JSON has not": (lambda _: replace(CARD, evaluation={"cost": np.nan}), ValueError),
    "cpu_seconds is '2', not float": (
        lambda _: replace(CARD, cpu_seconds="2"),  # type: ignore[arg-type]
        ValueError,
    ),
    "got 0 weights": (lambda _: replace(a_network(), weights=[]), ValueError),
    r"\(inputs,\)": (lambda _: replace(a_network(), mean=np.zeros((1, 3))), ValueError),
    "layer 0 takes 3 inputs": (
        lambda _: replace(a_network(), biases=[np.zeros(9), np.zeros(5), np.zeros(1)]),
        ValueError,
    ),
    "unknown activation .gelu.; did you mean": (
        lambda _: replace(a_network(), activation="gelu"),
        ValueError,
    ),
    "clip is above zero": (lambda _: replace(a_network(), clip=0.0), ValueError),
}


@pytest.mark.parametrize("message", REFUSALS)
def test_other_files_names_cards_and_networks_are_refused(tmp_path: Path, message: str) -> None:
    (tmp_path / "zip.safetensors").write_bytes(b"PK\x03\x04" + bytes(300))
    call, error = REFUSALS[message]
    with pytest.raises(error, match=message):
        call(tmp_path)
