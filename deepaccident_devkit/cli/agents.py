"""Options for selecting agents and cooperating agents, and for the links between these."""

from collections.abc import Callable, Sequence

import click

from deepaccident_devkit.cli.options import split_words
from deepaccident_devkit.cli.verbs import Function, field_option, together
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import AGENT_SETS, AVAILABLE, Link

_ALL = ("all", AVAILABLE)
agents_parameter = click.option(
    "--agents",
    multiple=True,
    metavar="NAME[,NAME…]",
    help="Use only samples of these agents; the cooperating agents stay the same.  [default: all]",
)


def agent_names(texts: Sequence[str]) -> tuple[str, ...]:
    """Return the agents that repeated --agents name; all agents without the option.

    `all` and `available` also mean all agents, because this only selects from existing samples.
    """
    names = [choice("--agents", name, (*AGENTS, *_ALL)) for name in split_words(texts)]
    if not names or set(names) & set(_ALL):
        return AGENTS
    return tuple(names)


def cooperating_parameter(meaning: str, default: str) -> Callable[[Function], Function]:
    """Make the option --agents for cooperating agents; `names_or_configuration` reads it."""
    return click.option(
        "--agents",
        multiple=True,
        metavar="NAME[,NAME…]",
        help=f"{meaning}: names, or one of {', '.join(AGENT_SETS)} (all in the release).  "
        f"[default: {default}]",
    )


def names_or_configuration(texts: Sequence[str]) -> str | list[str] | None:
    """Return the configuration or the agent names passed with repeated --agents.

    Return None if the option was not passed.
    """
    names = split_words(texts)
    if len(names) != 1:
        return names or None
    name = choice("--agents", names[0], (*AGENT_SETS, *AGENTS))
    if name in AGENTS:
        return names
    return name


def link_parameters(
    latency: float = 0.0, pose_noise: float = 0.0
) -> Callable[[Function], Function]:
    """Make the options for errors in partners' data, with these defaults."""
    return together(
        field_option(Link, "latency", default=latency),
        field_option(Link, "pose_noise", default=pose_noise, type=float),
    )
