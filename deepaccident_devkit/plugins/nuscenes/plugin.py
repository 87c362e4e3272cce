"""The subcommand and the opener that the plug-in `nuscenes` provides."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.support.plugins import PROTOCOL_VERSION, LazyVerb, Opener, Plugin

if TYPE_CHECKING:
    import click

    from deepaccident_devkit.deepaccident import DeepAccident


def _sensor_setups() -> click.Command:
    from deepaccident_devkit.plugins.nuscenes.cli import sensor_setups

    return sensor_setups


def _is_dataroot(folder: Path) -> bool:
    from deepaccident_devkit.release.layout import nuscenes_tables

    return nuscenes_tables(folder) is not None


def _open(dataroot: Path, index_dir: Path | None) -> DeepAccident:
    from deepaccident_devkit.plugins.nuscenes.source import open_nuscenes

    return open_nuscenes(dataroot, index_dir)


PLUGIN: Final = Plugin(
    name="nuscenes",
    protocol_version=PROTOCOL_VERSION,
    verbs={
        "sensor-setups": LazyVerb(
            "Compare the sensors and labels of two data sources.", _sensor_setups
        ),
    },
    openers={"nuScenes": Opener(recognizes=_is_dataroot, open_release=_open)},
)
