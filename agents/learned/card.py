"""A policy's card: what it was trained on, how, and what it costs against others."""

import json
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from typing import Any

import gymnasium as gym

from ... import __version__
from ...estimators.wrappers.estimate import EstimateObservation
from ..env_facts import AnyEnv, facts_of

JsonMap = dict[str, Any]


@dataclass(frozen=True)
class Card:
    """What stands beside the weights; JSON types only.

    env_id, env_options: of `gym.make`. estimator, estimator_options: of `EstimateObservation`
    around it, "" for none. observation: (name, unit) of each entry that the network takes.
    control_period: ticks. reference: of `envs.reference.REFERENCES`, by which it was judged.
    algorithm, algorithm_options: how it was trained. command: the line that
    made it. seeds: by purpose ("training", ...). steps: of the environment. cpu_seconds: of the
    training. sideslip: the version. evaluation: of `sideslip.benchmarks.enjoy`: seeds, and mean
    costs of the policy, of none and of the best classical line on them.

    Raises ValueError for a value of another type, or one that JSON has not.
    """

    env_id: str
    observation: tuple[tuple[str, str], ...]
    control_period: int
    reference: str
    env_options: JsonMap = field(default_factory=dict)
    estimator: str = ""
    estimator_options: JsonMap = field(default_factory=dict)
    algorithm: str = ""
    algorithm_options: JsonMap = field(default_factory=dict)
    command: str = ""
    seeds: JsonMap = field(default_factory=dict)
    steps: int = 0
    cpu_seconds: float = 0.0
    sideslip: str = __version__
    evaluation: JsonMap = field(default_factory=dict)

    def __post_init__(self) -> None:
        pairs = self.observation
        if not isinstance(pairs, list | tuple) or not all(map(_is_entry, pairs)):
            raise ValueError(f"the card's observation is a list of (name, unit), got {pairs!r}")
        object.__setattr__(self, "observation", tuple((name, unit) for name, unit in pairs))
        if len({name for name, _ in pairs}) != len(pairs):
            raise ValueError("the card's observation names an entry twice")
        if ":" in str(self.estimator):  # a file from elsewhere would name code to be imported
            raise ValueError(
                f"the card's estimator is a name, got the entry point {self.estimator!r}: "
                "sideslip.register_estimator gives it one"
            )
        for each in fields(self):
            value = getattr(self, each.name)
            kinds = _KINDS.get(each.type, ())
            if kinds and (isinstance(value, bool) or not isinstance(value, kinds)):
                wanted = " or ".join(kind.__name__ for kind in kinds)
                raise ValueError(f"the card's {each.name} is {wanted}, got {value!r}")
        self.to_json()

    @classmethod
    def of(
        cls,
        env_id: str,
        env_options: Mapping[str, Any] | None = None,
        estimator: str = "",
        estimator_options: Mapping[str, Any] | None = None,
        **rest: Any,
    ) -> "Card":
        """A card with the observation of this env and estimator; rest: the other fields."""
        options: JsonMap = {
            "env_id": env_id,
            "env_options": dict(env_options or {}),
            "estimator": estimator,
            "estimator_options": dict(estimator_options or {}),
        }
        env: gym.Env[Any, Any] = gym.make(env_id, **options["env_options"])
        if estimator:
            env = EstimateObservation(env, estimator, **options["estimator_options"])
        card = cls.seen(env, **options, **rest)
        env.close()
        return card

    @classmethod
    def seen(cls, env: AnyEnv, **rest: Any) -> "Card":
        """A card with the observation, control period and reference of an env, single or vector;
        rest: the other fields."""
        facts = facts_of(env)
        entries = tuple((entry.name, entry.unit) for entry in facts.layout)
        return cls(
            observation=entries,
            control_period=int(facts.control_period),
            reference=facts.reference,
            **rest,
        )

    @classmethod
    def from_mapping(cls, content: Any) -> "Card":
        """A card from its JSON object; ValueError for a field that is missing or unknown."""
        if not isinstance(content, dict):
            raise ValueError(f"a card is a JSON object, got {type(content).__name__}")
        known = {each.name: each for each in fields(cls)}
        needed = {
            name
            for name, each in known.items()
            if each.default is MISSING and each.default_factory is MISSING
        }
        for what, names in (
            ("lacks", needed - content.keys()),
            ("has unknown fields:", content.keys() - known),
        ):
            if names:
                raise ValueError(f"the card {what} {', '.join(sorted(names))}")
        return cls(**content)

    def to_json(self, **more: Any) -> str:
        """The card as a JSON object, with further fields."""
        try:
            return json.dumps(asdict(self) | more, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"the card holds what JSON has not: {error}") from None


_KINDS: dict[Any, tuple[type, ...]] = {
    str: (str,),
    int: (int,),
    float: (float, int),
    JsonMap: (dict,),
}


def _is_entry(pair: Any) -> bool:
    return (
        isinstance(pair, list | tuple)
        and len(pair) == 2
        and all(isinstance(word, str) for word in pair)
    )
