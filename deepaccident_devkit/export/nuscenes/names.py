"""What things are called in the nuScenes export: scenes, channels, moments, files, tokens.

mmdet3d's infos refer to the same files by the same names. All names follow from the release alone, so that exports of
parts agree with one of the whole.
"""

from __future__ import annotations

import hashlib
from types import MappingProxyType
from typing import Final

from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, LIDAR

VERSION: Final = "v1.0-deepaccident"
LIDAR_CHANNEL: Final = "LIDAR_TOP"
CAMERA_CHANNELS: Final = MappingProxyType(
    dict(
        zip(
            CAMERAS,
            ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"),
            strict=True,
        )
    )
)
"""Our camera → nuScenes' channel."""
CHANNEL_NAMES: Final = MappingProxyType({**CAMERA_CHANNELS, LIDAR: LIDAR_CHANNEL})
ENDINGS: Final = MappingProxyType({**dict.fromkeys(CAMERAS, "jpg"), LIDAR: "pcd.bin"})
_EPOCH: Final = 1_600_000_000_000_000
_HOUR: Final = 3_600_000_000
_PERIOD: Final = 100_000


def token(kind: str, *parts: object) -> str:
    """A token of 32 hexadecimal digits for a row of a table, from what it is."""
    return hashlib.md5("/".join(map(str, (kind, *parts))).encode(), usedforsecurity=False).hexdigest()


def scene_name(scenario: str, agent: str) -> str:
    """A scene is what one agent recorded of a scenario, given by its token: `<type>-<scenario>-<agent>`."""
    return f"{scenario.replace('/', '-')}-{agent}"


def timestamp(scenario_row: int, agent: str, number: int) -> int:
    """Microseconds of a frame; the devkit of nuScenes sorts scenes by their first one, so no two are the same.

    Args:
        scenario_row: of the scenario table, which gets an hour of its own.
        agent: who recorded it; agents are a microsecond apart.
        number: of the frame, from 1.
    """
    return _EPOCH + (scenario_row + 1) * _HOUR + number * _PERIOD + AGENTS.index(agent)


def sensor_path(scene: str, channel: str, stamp: int, *, key: bool) -> str:
    """The path of a sensor file below the folder; `channel` is ours."""
    name = CHANNEL_NAMES[channel]
    return f"{'samples' if key else 'sweeps'}/{name}/{scene}__{name}__{stamp}.{ENDINGS[channel]}"
