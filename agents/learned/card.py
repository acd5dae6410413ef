"""A policy's card: what it was trained on, how, and what it costs against others."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from ... import __version__
from ...envs.documents import check_types
from ...estimators.user_files import is_user_file
from ...estimators.wrappers.estimate import EstimateObservation
from ..env_facts import AnyEnv, get_env_facts, make_env

JsonMap = dict[str, Any]


@dataclass(frozen=True)
class Card:
    """What stands beside the weights; JSON types only.

    env_id, env_options: of `gym.make`. estimator, estimator_options: of `EstimateObservation`
    around it, "" for none. observation: (name, unit) of each entry that the network takes.
    control_period: ticks. reference: of `envs.task.reference.REFERENCES`, by which it was judged.
    algorithm, algorithm_options: how it was trained. command: the line that made it. seeds: by
    purpose ("training", ...). steps: of the environment. cpu_seconds: of the training. sideslip:
    the version. evaluation: of `benchmarks.policies.evaluation`: seeds, and mean costs of the
    policy, of none and of the best classical line on them.

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
            raise ValueError(f"observation is a list of (name, unit), got {pairs!r}")
        object.__setattr__(self, "observation", tuple((name, unit) for name, unit in pairs))
        if len({name for name, _ in pairs}) != len(pairs):
            raise ValueError("observation names an entry twice")
        check_types(Card, vars(self), "the card")
        check_names_no_code(self.env_id, self.estimator, self.estimator_options)
        self.to_json()

    @classmethod
    def from_env_id(
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
        env = make_env(env_id, options["env_options"])
        if estimator:
            env = EstimateObservation(env, estimator, **options["estimator_options"])
        card = cls.from_env(env, **options, **rest)
        env.close()
        return card

    @classmethod
    def from_env(cls, env: AnyEnv, **rest: Any) -> "Card":
        """A card with the observation, control period and reference of an env, single or vector;
        rest: the other fields."""
        facts = get_env_facts(env)
        entries = tuple((entry.name, entry.unit) for entry in facts.layout)
        return cls(
            observation=entries,
            control_period=int(facts.control_period),
            reference=facts.reference,
            **rest,
        )

    def to_json(self, **extra: Any) -> str:
        """The card as a JSON object, with further fields."""
        try:
            return json.dumps(asdict(self) | extra, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"the card holds what JSON has not: {error}") from None


def check_names_no_code(env_id: str, estimator: str, estimator_options: JsonMap) -> None:
    """ValueError where a file from elsewhere names code to be imported instead of what is there."""
    if "estimator" in estimator_options:
        raise ValueError("estimator_options holds an estimator, which is none of its options")
    if ":" in env_id:
        raise ValueError(
            f"env_id is that of a registered env, got {env_id!r}, which names a module: import it "
            "first and give the id alone"
        )
    if ":" in estimator or is_user_file(estimator):
        raise ValueError(
            f"estimator is a name, got the entry point {estimator!r}: "
            "sideslip.register_estimator gives it one"
        )


def _is_entry(pair: Any) -> bool:
    return (
        isinstance(pair, list | tuple)
        and len(pair) == 2
        and all(isinstance(word, str) for word in pair)
    )
