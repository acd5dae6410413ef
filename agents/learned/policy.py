"""A learned policy as one more controller: weights from a file, run by NumPy."""

from pathlib import Path

from ...envs.record import Array
from ..controllers.base import Controller
from ..env_facts import AnyEnv, get_env_facts
from .files import Policy, load_policy

DEFAULT = "ppo-yaw-vision"


class PolicyController(Controller):
    """The deterministic action of a policy's network, clipped to [-1, 1].

    The network's memory of an episode (frames, cells) is in the state of `predict`. It reads the
    entries of its training by name, so a wider observation serves as well. Entries that never
    varied in training are not read. Where the env steers and the policy does not, the added
    steering is zero. Single and batch agree to rounding in double precision, before the action
    becomes single precision (`Network`).

    Args:
        env: Env of the controller.
        policy: Shipped name, file's path, or `Policy`.

    Raises:
        ValueError: The env lacks an entry that the policy reads or has another unit of it, has
            another control period, or its action is narrower; or as `load_policy`.
    """

    def __init__(self, env: AnyEnv, policy: str | Path | Policy = DEFAULT) -> None:
        self.policy = policy if isinstance(policy, Policy) else load_policy(policy)
        name, card, facts = self.policy.name, self.policy.card, get_env_facts(env)
        reads = self.policy.reads
        entries = [entry for entry, read in zip(card.observation, reads, strict=True) if read]
        units = {entry.name: entry.unit for entry in facts.layout}
        wrong = [
            f"{label} in {unit} (here {units[label]})"
            for label, unit in entries
            if units.get(label, unit) != unit
        ]
        if wrong:
            raise ValueError(f"policy {name} was trained on {', '.join(wrong)}")
        if facts.control_period != card.control_period:
            raise ValueError(
                f"policy {name} was trained with a control period of {card.control_period} ticks, "
                f"this env has {facts.control_period}"
            )
        if facts.width < self.policy.network.width:
            raise ValueError(
                f"policy {name} gives {self.policy.network.width} numbers, "
                f"the env's action has {facts.width}"
            )
        self.needs = tuple(label for label, _ in entries)
        try:
            super().__init__(env)
        except ValueError as error:
            trained_on, available = (", ".join(names) for names in (dict(card.observation), units))
            raise ValueError(
                f"{error}. {name} was trained on {trained_on}; here are {available}"
            ) from None
        self.network = self.policy.network.select_inputs(reads)
        self.memory = self.network.memory

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        action[:, : self.network.width] = self.network(inputs, state)
