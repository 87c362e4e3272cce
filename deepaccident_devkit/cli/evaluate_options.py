"""The options that say which samples are evaluated, and by which rules."""

from collections.abc import Mapping
from typing import Any, get_args

import click

from deepaccident_devkit.cli.options import Verb, WordChoice, agent_names, agents_parameter
from deepaccident_devkit.evaluation.metrics.intervals import MOST_RESAMPLES, RESAMPLES
from deepaccident_devkit.evaluation.runs import SampleSelection, default_selection
from deepaccident_devkit.evaluation.runs.selection import SampleList, ScopeName
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.motion.sample_lists import Scope
from deepaccident_devkit.taxonomy import AGENTS

_SELECTION = (
    click.option(
        "--split",
        default="val",
        show_default=True,
        help="train, val, test, train_mini, val_mini, or a split file (.txt).",
    ),
    click.option(
        "--samples",
        type=WordChoice(get_args(SampleList)),
        help="evaluate: samples within the horizon before the end. all: two samples per second of each scenario.  "
        "[default: evaluate; for warnings: all]",
    ),
    click.option(
        "--scope",
        type=WordChoice(get_args(ScopeName)),
        help="Accident scenarios only, or all scenarios.  [default: accident; with --samples all: all]",
    ),
    agents_parameter,
    click.option("--horizon", default=2.0, show_default=True, help="How many seconds the predictions look ahead."),
)
purpose_parameter = click.option(
    "--samples",
    "purpose",
    type=WordChoice(["evaluate", "all"]),
    default="evaluate",
    show_default=True,
    help="evaluate: samples within the horizon before the end. all: two samples per second of each scenario.",
)
scope_parameter = click.option(
    "--scope",
    type=WordChoice(get_args(Scope)),
    default="accident",
    show_default=True,
    help="Accident scenarios only, or all scenarios.",
)
resamples_parameter = click.option(
    "--resamples",
    type=click.IntRange(min=0, max=MOST_RESAMPLES),
    default=RESAMPLES,
    show_default=True,
    help="Number of resamples for intervals and tests, at most; 0 for no intervals and no tests.",
)


def selection_parameters(verb: Verb) -> Verb:
    """Give a verb --split, --samples, --scope, --agents and --horizon."""
    for parameter in reversed(_SELECTION):
        verb = parameter(verb)
    return verb


def selection_of(setup: EvaluationSetup, options: Mapping[str, Any]) -> SampleSelection:
    """The samples that a verb's options name."""
    agents = agent_names(options["agents"])
    return default_selection(
        setup,
        options["split"],
        samples=options["samples"],
        scope=options["scope"],
        agents=None if agents == AGENTS else agents,
    )


def switches_of(texts: tuple[str, ...]) -> dict[str, Any]:
    """The names and values of repeated --switch NAME=VALUE; a value that is no JSON stays a text."""
    switches: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise click.BadParameter(f"--switch: expected NAME=VALUE, found {text!r}")
        try:
            switches[name] = parsed_json(value.encode())
        except ValueError:
            switches[name] = value
    return switches
