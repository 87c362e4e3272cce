"""Options that say which agents are meant, which of them cooperate, and what their links do to what is sent."""

from collections.abc import Callable, Sequence

import click

from deepaccident_devkit.cli.options import words_of
from deepaccident_devkit.cli.verbs import Function, field_option, together
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import AGENT_SETS, AVAILABLE, Link

_ALL = ("all", AVAILABLE)
agents_parameter = click.option(
    "--agents",
    multiple=True,
    metavar="NAME[,NAME…]",
    help="Only samples of these agents; it does not choose who cooperates.  [default: all]",
)


def agent_names(given: Sequence[str]) -> tuple[str, ...]:
    """The agents of repeated --agents; no text means all.

    `all` and `available` do too: this only chooses among the samples that are there.
    """
    names = [choice("--agents", name, (*AGENTS, *_ALL)) for name in words_of(given)]
    return AGENTS if not names or set(names) & set(_ALL) else tuple(names)


def cooperating_parameter(whose: str, default: str) -> Callable[[Function], Function]:
    """An option --agents for agents that cooperate (`names_or_configuration` reads it)."""
    return click.option(
        "--agents",
        multiple=True,
        metavar="NAME[,NAME…]",
        help=f"{whose}: names, or one of {', '.join(AGENT_SETS)} (those that are there).  [default: {default}]",
    )


def names_or_configuration(given: Sequence[str]) -> str | list[str] | None:
    """Repeated --agents for agents that cooperate: one configuration, names, or None if it was not given."""
    names = words_of(given)
    if len(names) != 1:
        return names or None
    alone = choice("--agents", names[0], (*AGENT_SETS, *AGENTS))
    return names if alone in AGENTS else alone


def link_parameters(
    latency: float = 0.0, pose_noise: float = 0.0
) -> Callable[[Function], Function]:
    """Options for what happens to partners' data, with these defaults."""
    return together(
        field_option(Link, "latency", default=latency),
        field_option(Link, "pose_noise", default=pose_noise, type=float),
    )
