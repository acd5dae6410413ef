"""Names that users give to estimators and agents of their own, as Gymnasium's `register` does."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sideslip.agents import AGENTS, register_agent
from sideslip.estimators import FILTERS, make_estimator, register_estimator
from sideslip.estimators.make import ESTIMATORS
from sideslip.estimators.registry import _import_entry_point, find_entry_point
from tests.estimators.wrappers.constant import Constant

CONSTANT = "tests.estimators.wrappers.constant:Constant"


@pytest.fixture(autouse=True)
def own_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is gone after it."""
    for registry in (ESTIMATORS, AGENTS):
        monkeypatch.setattr(registry, "_factories", dict(registry._factories))


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A module of the user's that fails while it is imported."""
    (tmp_path / "needs_more.py").write_text("import nowhere_to_be_found\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "needs_more"
    sys.modules.pop("needs_more", None)


@pytest.mark.parametrize("factory", [Constant, CONSTANT, lambda **_: Constant()])
def test_a_registered_name_is_a_name_like_ours(factory: Any) -> None:
    register_estimator("mine", factory)
    assert "mine" in ESTIMATORS and list(ESTIMATORS) == [*FILTERS, "mine"]
    made: Any = make_estimator("mine", speed=7.0)
    assert made.names == Constant.names and made.name == "mine" and made.units[1] == "rad/s"
    register_estimator("mine", factory)  # the same once more, as in a module imported twice
    with pytest.raises(ValueError, match="the estimator 'mine' is registered already, as"):
        register_estimator("mine", "somewhere:Else")
    with pytest.raises(ValueError, match="unknown estimator 'mime'; did you mean 'mine'"):
        make_estimator("mime")


def test_ours_are_in_it_and_cannot_be_taken() -> None:
    assert make_estimator("bicycle-kf").name == ESTIMATORS.load("bicycle-kf")().name
    with pytest.raises(ValueError, match="estimator 'dakf' is registered already"):
        register_estimator("dakf", Constant)
    with pytest.raises(ValueError, match="agent 'lqr' is registered already"):
        register_agent("lqr", CONSTANT)
    for policy in ("distill-car-yaw", "here/mine.safetensors"):
        with pytest.raises(ValueError, match="is the name of a policy"):
            register_agent(policy, CONSTANT)


@pytest.mark.parametrize("register", [register_estimator, register_agent])
def test_what_cannot_be_registered(register: Any) -> None:
    with pytest.raises(TypeError, match="is a str, got 3"):
        register(3, Constant)
    for name in ("", "a:b"):
        with pytest.raises(ValueError, match=f"has letters and no colon, got '{name}'"):
            register(name, Constant)
    with pytest.raises(TypeError, match=r"'mine': a factory is callable or 'package.mod.* got int"):
        register("mine", 3)
    for text in ("Constant", "package.module:", ":Constant", "a b:C", "../a:C", "a:b:C", "a..b:C"):
        with pytest.raises(ValueError, match="an entry point is 'package"):
            register("mine", text)
    assert "mine" not in ESTIMATORS and "mine" not in AGENTS


def test_an_entry_point_is_imported_when_asked_for(module: str) -> None:
    assert (
        _import_entry_point("tests.estimators.wrappers.constant:Constant.reset") is Constant.reset
    )
    for text, message in (
        ("nowhere:Thing", "'nowhere:Thing': there is no module 'nowhere'"),
        ("tests.nowhere.at_all:Thing", "there is no module 'tests.nowhere'"),
        (f"{CONSTANT}.value", "the module 'tests.estimators.wrappers.constant' has no"),
    ):
        register_estimator(f"broken-{text.count('.')}", text)
        with pytest.raises(ValueError, match=message):
            make_estimator(f"broken-{text.count('.')}")
    with pytest.raises(TypeError, match="is no factory but of type tuple"):
        _import_entry_point(f"{CONSTANT}.names")
    with pytest.raises(ModuleNotFoundError, match="nowhere_to_be_found"):  # the user's own error
        make_estimator(f"{module}:Thing")


def test_what_can_be_found_again_has_an_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_entry_point(Constant) == CONSTANT
    monkeypatch.setattr(Constant, "__module__", "__main__")  # another process has another one
    assert find_entry_point(Constant) is None
    nameless: Any
    for nameless in (lambda: None, Constant(), Constant().reset):
        assert find_entry_point(nameless) is None
