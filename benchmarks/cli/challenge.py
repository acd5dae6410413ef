"""`sideslip bench control` with contestants of the user's own."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from .names import complete

if TYPE_CHECKING:
    from ..entrants.challenge import ComparisonRequest

Agents = Annotated[
    list[str] | None,
    typer.Option(
        "--agent",
        help="Your own: FILE.py:Class, a policy's path, a name; repeatable.",
        autocompletion=complete("agents", "policies"),
    ),
]
Estimators = Annotated[
    list[str] | None,
    typer.Option("--estimator", help="FILE.py:Class, a name, none; repeatable."),
]
Scenarios = Annotated[
    list[str] | None, typer.Option("--scenario", help="A name or a file; repeatable.")
]
EnvId = Annotated[str, typer.Option("--env", help="The contests of this id alone.")]
Fresh = Annotated[
    bool, typer.Option("--fresh", help="Seeds drawn after your files are hashed: publishable.")
]
Limit = Annotated[float, typer.Option(help="s of wall time for a contestant in a contest.")]


def make_request(
    suites: Sequence[str],
    agents: Sequence[str],
    estimators: Sequence[str],
    vehicle: str | None,
    scenarios: Sequence[str],
    env_id: str,
    fresh: bool,
    salt: str,
    limit: float,
    episodes: int | None,
    quick: bool,
    trust: bool,
) -> "ComparisonRequest | None":
    """The challenge of a command line, None without contestants; ValueError for options that go
    with them alone, or with the suite `control` alone."""
    if not (agents or estimators):
        if scenarios or env_id or fresh:
            raise ValueError("--scenario, --env and --fresh go with --agent or --estimator")
        return None
    if list(suites) not in ([], ["control"]):
        raise ValueError("--agent and --estimator go with the suite control alone")
    from ..control.cells import QUICK_EPISODES
    from ..entrants.challenge import EPISODES, ComparisonRequest, make_user_entries

    pairs = make_user_entries(
        agents, ["" if name == "none" else name for name in estimators], trust
    )
    if not pairs:
        raise ValueError("--estimator none goes with --agent")
    n_episodes = episodes or (QUICK_EPISODES if quick else EPISODES)
    return ComparisonRequest(
        tuple(pairs), vehicle, tuple(scenarios), env_id, n_episodes, None, fresh, salt, limit
    )
