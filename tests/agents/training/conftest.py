"""Trainings of tests measure their scaling on few environments, and leave torch's threads alone."""

from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="module")
def small() -> Iterator[None]:
    torch = pytest.importorskip("torch")
    trainer = pytest.importorskip("sideslip.agents.training.trainer", exc_type=ImportError)
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "_SCALING_ENVS", 8)
        yield
    torch.set_num_threads(threads)
