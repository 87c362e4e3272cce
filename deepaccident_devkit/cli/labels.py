"""`deepaccident labels`: writes the motion labels of a split into a folder."""

from dataclasses import replace
from typing import Any, get_args

import click

from deepaccident_devkit.cli.agents import agent_names, agents_parameter
from deepaccident_devkit.cli.options import (
    engine_options,
    open_release,
    parse_switches,
    release_parameters,
)
from deepaccident_devkit.cli.verbs import WordChoice, advanced, field_option, verb
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    PRESETS,
    LabelProtocol,
    MotionLabelConfig,
    write_label_files,
)
from deepaccident_devkit.motion.batch_names import BatchNames
from deepaccident_devkit.motion.config import NO_PRESETS, slip_names
from deepaccident_devkit.motion.label_folder import LabelManifest, folder_path
from deepaccident_devkit.selection.samples import Purpose
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.v2x import AGENT_SETS


@verb()
@release_parameters
@click.option(
    "--split",
    required=True,
    help="Split to write: train, val, train_mini, val_mini, all, or a split file (.txt).",
)
@click.option(
    "--out",
    required=True,
    metavar="FOLDER",
    help="Folder to write into: a new folder, or one with labels of the same kind.",
)
@agents_parameter
@click.option(
    "--samples",
    "purpose",
    type=WordChoice(get_args(Purpose)),
    default="every",
    show_default=True,
    help="Samples to write. every: all samples (10 Hz). all, keyframes: two per second. train, "
    "evaluate: those of training and of evaluation.",
)
@click.option(
    "--preset",
    type=WordChoice(PRESETS, NO_PRESETS),
    default="deepaccident",
    show_default=True,
    help="Grid, orientation and protocol of the labels.",
)
@click.option(
    "--protocol",
    type=WordChoice(LABEL_PROTOCOLS),
    help="Rules of the labels.  [default: those of the preset]",
)
@advanced(
    "--switch",
    "switches",
    multiple=True,
    metavar="NAME=yes|no",
    help="Switch one quirk of the protocol on or off. You can repeat this option.",
)
@click.option(
    "--seen-by",
    type=WordChoice(AGENT_SETS),
    help="Label only actors that these agents see.  [default: all actors]",
)
@field_option(MotionLabelConfig, "only_vehicle")
@click.option(
    "--names",
    type=WordChoice(get_args(BatchNames)),
    help="Write one plain npz file per sample, for code without the devkit: the arrays that the "
    "loader of this code returns, with its names, axes, types and orientation. A sample takes "
    "about 0.1 MB, 25 times as much as in label files.  [default: label files]",
)
def labels(
    split: str,
    out: str,
    agents: tuple[str, ...],
    purpose: Purpose,
    names: BatchNames | None,
    **options: Any,
) -> None:
    """Write the motion labels of one split of the release in DATAROOT.

    The command writes one file per scenario and agent. If a run is interrupted, the same command
    continues it.
    """
    config = _pop_config(options)
    agents = agent_names(agents)
    LabelManifest.of(folder_path(out), config, names)  # fails before the release is indexed
    dataset = open_release(**options)
    tokens = []
    for token in dataset.samples(split, purpose):
        _, agent, _ = token.rsplit("/", 2)
        if agent in agents:
            tokens.append(token)
    if not tokens:
        raise NotAvailableError(
            f"{split}: has no labelled samples of {', '.join(agents)} with --samples {purpose}"
        )
    outcome = write_label_files(
        dataset,
        out,
        tokens,
        config,
        names=names,
        **engine_options(options),
        progress=True,
    )
    samples = counted(outcome.samples, "sample")
    files = counted(outcome.written, "new file")
    click.echo(f"wrote {out}: {samples} ({files}, {outcome.kept:,} already there)")


def _pop_config(options: NamedValues) -> MotionLabelConfig:
    """Remove the options for the label configuration from `options`; return the configuration."""
    preset = options.pop("preset")
    switches = options.pop("switches")
    values = {
        "protocol": options.pop("protocol"),
        "agents": options.pop("seen_by"),
        "only_vehicle": options.pop("only_vehicle") or None,
    }
    changes: NamedValues = {name: value for name, value in values.items() if value is not None}
    config = MotionLabelConfig.preset(preset, **changes)
    if switches:
        return replace(config, protocol=_switch_rules(config.rules, switches))
    return config


def _switch_rules(rules: LabelProtocol, texts: tuple[str, ...]) -> LabelProtocol:
    switches = parse_switches(texts)
    for name, value in switches.items():
        if name not in slip_names() or not isinstance(value, bool):
            names = ", ".join(slip_names())
            raise click.BadParameter(
                f"--switch: expected yes or no for one of {names}, found {', '.join(texts)}"
            )
    return replace(rules, **switches)
