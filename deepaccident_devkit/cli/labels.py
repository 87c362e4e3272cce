"""`deepaccident labels`: the motion labels of a split, written into a folder."""

from dataclasses import replace
from typing import Any, get_args

import click

from deepaccident_devkit.cli.agents import agent_names, agents_parameter
from deepaccident_devkit.cli.options import engine_of, open_release, release_parameters, switches_of
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
from deepaccident_devkit.v2x import AGENT_SETS

_CONFIG_OPTIONS = ("preset", "protocol", "switches", "seen_by", "only_vehicle")


@verb()
@release_parameters
@click.option(
    "--split", required=True, help="train, val, train_mini, val_mini, all, or a split file (.txt)."
)
@click.option(
    "--out",
    required=True,
    metavar="FOLDER",
    help="Folder to write into: a new one, or one with labels of the same kind.",
)
@agents_parameter
@click.option(
    "--samples",
    "purpose",
    type=WordChoice(get_args(Purpose)),
    default="every",
    show_default=True,
    help="every: all samples (10 Hz). all, keyframes: two samples per second. train, evaluate: "
    "those of training and evaluation.",
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
    help="Rules of the labels.  [default: of the preset]",
)
@advanced(
    "--switch",
    "switches",
    multiple=True,
    metavar="NAME=yes|no",
    help="Switch one quirk of the protocol on or off.",
)
@click.option(
    "--seen-by",
    type=WordChoice(AGENT_SETS),
    help="Only actors that these agents see.  [default: all actors]",
)
@field_option(MotionLabelConfig, "only_vehicle")
@click.option(
    "--names",
    type=WordChoice(get_args(BatchNames)),
    help="Write one plain npz file per sample, for loops without the devkit: the arrays that this "
    "code's loader gives, with its names, axes, types and orientation. Takes some 0.1 MB per "
    "sample, 25 times as much as label files.  [default: label files]",
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

    There is one file per scenario and agent. If a run is interrupted, the same command continues
    it.
    """
    config = _config(options)
    agents = agent_names(agents)
    LabelManifest.of(folder_path(out), config, names)  # before the release is indexed
    dataset = open_release(**options)
    tokens = [
        token for token in dataset.samples(split, purpose) if token.rsplit("/", 2)[1] in agents
    ]
    if not tokens:
        raise NotAvailableError(
            f"{split}: has no labelled samples of {', '.join(agents)} for --samples {purpose}"
        )
    done = write_label_files(
        dataset,
        out,
        tokens,
        config,
        names=names,
        **engine_of(options),
        progress=True,
    )
    written = counted(done.written, "file")
    click.echo(
        f"{counted(done.samples, 'sample')} in {out}: {written} written, {done.kept} were there "
        "already"
    )


def _config(options: dict[str, Any]) -> MotionLabelConfig:
    """Remove the options of the label configuration from a verb's options, and return it."""
    preset, protocol, switches, seen_by, only_vehicle = (
        options.pop(name) for name in _CONFIG_OPTIONS
    )
    named = {"protocol": protocol, "agents": seen_by, "only_vehicle": only_vehicle or None}
    changes: dict[str, Any] = {name: value for name, value in named.items() if value is not None}
    config = MotionLabelConfig.preset(preset, **changes)
    if switches:
        return replace(config, protocol=_switched(config.rules, switches))
    return config


def _switched(rules: LabelProtocol, texts: tuple[str, ...]) -> LabelProtocol:
    switches = switches_of(texts)
    for name, value in switches.items():
        if name not in slip_names() or not isinstance(value, bool):
            names = ", ".join(slip_names())
            raise click.BadParameter(
                f"--switch: expected yes or no for one of {names}; found {', '.join(texts)}"
            )
    return replace(rules, **switches)
