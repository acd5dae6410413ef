"""Who drives in `sideslip run`: an agent and its estimator, on an environment that suits both."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from ...agents import make_agent
from ...agents.env_facts import make_env
from ...estimators.wrappers.arguments import choose_estimator
from ...estimators.wrappers.estimate import EstimateObservation
from ..control.build import list_outputs
from ..harness.drives import call_quietly
from .names import check_env

_USUAL = ("sideslip/YawVision-v0", "sideslip/AfsYawFusion-v0")


@dataclass(frozen=True)
class AgentSpec:
    """The names of an agent and its estimator (None: without one), and their options.

    trust: whether a policy's zip may be read, which runs code of its maker's.
    """

    agent: str
    agent_options: dict[str, Any]
    estimator: str | None
    estimator_options: dict[str, Any]
    trust: bool = False

    def build(self, env_id: str | None, options: dict[str, Any]) -> tuple[gym.Env[Any, Any], Any]:
        """(the env with the estimator, the agent), on the first of the usual ids that fits.

        options: of the env. Raises ValueError or TypeError for what is unknown or does not fit.
        """
        if env_id is not None:
            check_env(env_id)
            return self._build(env_id, options)
        first, *others = _USUAL
        try:
            return self._build(first, options)
        except ValueError:
            for other in others:
                try:
                    return self._build(other, options)
                except (TypeError, ValueError):
                    continue
            raise

    def _build(self, env_id: str, options: dict[str, Any]) -> tuple[gym.Env[Any, Any], Any]:
        env = make_env(env_id, options)
        sensors = env.get_wrapper_attr("slow_sensors")
        if self.estimator is not None:
            outputs, filter_options = list_outputs(self.estimator), self.estimator_options
            env = call_quietly(
                EstimateObservation, env, self.estimator, outputs, options=filter_options or None
            )
        elif self.estimator_options:
            raise ValueError("--estimator-option needs --estimator")
        try:
            return env, make_agent(self.agent, env, trust=self.trust, **self.agent_options)
        except ValueError as error:
            if self.estimator is None and "_hat" in str(error):
                raise ValueError(
                    f"{self.agent} works on an estimate: add --estimator, for example "
                    f"--estimator {choose_estimator(sensors)}"
                ) from None
            raise
