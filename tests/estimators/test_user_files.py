"""Classes in a user's files: which one is meant, what is wrong with a file, and where."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from sideslip.agents import AGENTS, make_agent, register_agent
from sideslip.estimators import FILTERS, make_estimator, register_estimator
from sideslip.estimators.make import (
    ESTIMATORS,
    _import_entry_point,
    _load_user_class,
    describe_error,
    find_class,
    find_entry_point,
    is_user_file,
)
from tests.estimators.wrappers.constant import Constant

pytestmark = pytest.mark.usefixtures("own_names")

AGENT = """
class Still:
    def __init__(self, env):
        self.env = env

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return [0.0], state
"""
FILTER = """
class Filter:
    names, x, P = ("beta", "gamma"), (0.1, 0.2), [[1.0, 0.0], [0.0, 1.0]]

    def __init__(self, **arguments):
        self.arguments = arguments

    def reset(self, sensors, first):
        pass

    def step(self, rows, packets):
        pass
"""


def file(folder: Path, text: str, name: str = "my.py") -> str:
    (folder / name).write_text(text)
    return str(folder / name)


def test_a_files_class_is_a_name(tmp_path: Path) -> None:
    """Of an agent and of an estimator; a registered one too; a file that imports nothing does."""
    mine, env = file(tmp_path, AGENT), gym.make("sideslip/YawVision-v0")
    for name in (mine, f"{mine}:Still"):
        agent: Any = make_agent(name, env)
        assert type(agent).__name__ == "Still"
        assert agent.env is env
    assert _load_user_class(mine) is _load_user_class(f"{mine}:Still")  # run once
    register_agent("still-of-a-file", f"{mine}:Still")
    assert type(make_agent("still-of-a-file", env)).__name__ == "Still"
    own = make_estimator(f"{file(tmp_path, FILTER, 'my-filter.py')}:Filter", dt=0.002)
    assert own.names == ("beta", "gamma") and own.dt == 0.002


def test_another_text_is_another_class_and_neighbours_are_found(tmp_path: Path) -> None:
    mine = file(tmp_path, "from my_neighbour import GAIN\n\n\ndef build(env):\n    return GAIN\n")
    file(tmp_path, "GAIN = 3\n", "my_neighbour.py")
    assert _load_user_class(f"{mine}:build")(None) == 3
    file(tmp_path, "def build(env):\n    return 4\n")
    assert _load_user_class(f"{mine}:build")(None) == 4


BAD = {
    "no class": ("GAIN = 3\n", "", "say what of .*my.py is meant, .* it defines no class"),
    "nothing": ("", "", "it defines no class"),
    "two classes": (AGENT + FILTER, "", r"as .*my.py:NAME; it defines Still, Filter"),
    "in a comment": (AGENT + "# Other\n", ":Other", "my.py has no 'Other'; it defines Still"),
    "another class": (AGENT, ":Stil", "my.py has no 'Stil'; it defines Still"),
    "no Python": ("class Still:\n    def :\n", "", "my.py, line 2: invalid syntax"),
    "null bytes": ("\0", "", "my.py"),
    "raises": ("class A:\n    x = np.zeros(3)\n", "", "NameError: name 'np' is .* line 2"),
    "another type": ("GAIN = 3\n", ":GAIN", "no class or function but of type int"),
    "gone": ("class A: ...\n\n\ndel A\n", "", "my.py has no 'A' once it is run"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_file_that_has_no_class_for_us_is_refused(case: str, tmp_path: Path) -> None:
    text, name, message = BAD[case]
    with pytest.raises((ValueError, TypeError), match=message):
        _load_user_class(file(tmp_path, text) + name)


def test_what_is_found_is_not_run(tmp_path: Path) -> None:
    mine = file(tmp_path, "class A: ...\n\n\nraise SystemExit\n")
    assert find_class(mine) == (Path(mine), "A")
    with pytest.raises(FileNotFoundError, match=r"there is no file .*other\.py"):
        find_class(str(tmp_path / "other.py:A"))


@pytest.mark.parametrize("text", ["package.module:Name", "lqr", "x.zip", "a.safetensors", "py:A"])
def test_other_names_are_no_files(text: str) -> None:
    assert not is_user_file(text)


def test_a_reason_has_the_line_of_the_users_file(tmp_path: Path) -> None:
    path = file(tmp_path, "def build(x):\n    y = 1\n    return y / x\n")
    build = _load_user_class(f"{path}:build")
    with pytest.raises(ZeroDivisionError) as caught:
        build(0)
    assert describe_error(caught.value) == "ZeroDivisionError: division by zero (my.py, line 3)"
    assert describe_error(ValueError("ours")) == "ValueError: ours"


CONSTANT = "tests.estimators.wrappers.constant:Constant"


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
    assert _import_entry_point(f"{CONSTANT}.reset") is Constant.reset
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
