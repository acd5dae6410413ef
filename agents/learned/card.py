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
    """The card of a policy: what it was trained on, how, and its evaluation; JSON types only.

    Attributes:
        env_id: Id of the env.
        observation: (name, unit) of each entry that the network takes.
        control_period: Ticks between two decisions.
        reference: Name in `envs.task.reference.REFERENCES`, by which the policy was judged.
        env_options: Arguments of `gym.make`.
        estimator: Estimator of `EstimateObservation` around the env, "" for none.
        estimator_options: Other arguments of `EstimateObservation`.
        algorithm: Name of the training's algorithm.
        algorithm_options: Options of the training.
        command: Command line of the training.
        seeds: Seeds by purpose ("training", ...).
        steps: Steps of the environment.
        cpu_seconds: CPU time of the training (s).
        sideslip: Version of the package.
        evaluation: Result of `benchmarks.policies.evaluation`: seeds, and mean costs on them of the
            policy, of no control and of the best classical line.

    Raises:
        ValueError: A value has another type, or one that JSON does not have.
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
        """Make a card with the observation of an env and its estimator.

        Args:
            env_id: Id of the env.
            env_options: Arguments of `gym.make`.
            estimator: Estimator around the env, "" for none.
            estimator_options: Other arguments of `EstimateObservation`.
            rest: Other fields of the card.

        Returns:
            Card of the env.
        """
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
        """Make a card with the observation, control period and reference of an env.

        Args:
            env: Env, single or vector.
            rest: Other fields of the card.

        Returns:
            Card of the env.
        """
        facts = get_env_facts(env)
        entries = tuple((entry.name, entry.unit) for entry in facts.layout)
        return cls(
            observation=entries,
            control_period=int(facts.control_period),
            reference=facts.reference,
            **rest,
        )

    def to_json(self, **extra: Any) -> str:
        """Convert the card to a JSON object.

        Args:
            extra: Further fields.

        Returns:
            Text of the object.

        Raises:
            ValueError: The card or a field has a value that JSON does not have.
        """
        try:
            return json.dumps(asdict(self) | extra, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"the card holds what JSON has not: {error}") from None


def check_names_no_code(env_id: str, estimator: str, estimator_options: JsonMap) -> None:
    """Check that a foreign file names no code to import.

    Args:
        env_id: Id of a registered env.
        estimator: Name of an estimator, or "".
        estimator_options: Arguments of `EstimateObservation`, without an estimator.

    Raises:
        ValueError: The id or the estimator is an entry point or a file.
    """
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
