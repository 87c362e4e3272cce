"""Names and numbers of the dataset: agents, channels, categories, splits.

See docs/format.md, and docs/released_code.md, Conventions and samples.
"""

from typing import Final, Literal

AgentName = Literal[
    "ego_vehicle", "ego_vehicle_behind", "other_vehicle", "other_vehicle_behind", "infrastructure"
]
Frame = Literal["world", "ego", "lidar"]
OnError = Literal["raise", "skip"]
Layout = Literal["A", "B"]
ModelPreset = Literal["released", "tiny", "tiny_lidar", "tiny_both"]
StyleName = Literal["paper", "cvpr-column", "cvpr-page", "ieee-column", "ieee-page", "slide"]
ModelFusion = Literal["mean", "max", "released", "disconet", "cobevt", "v2xvit"]
SHIPPED_WEIGHTS: Final = ("tiny", "tiny_lidar")
"""Presets with weights that ship with the devkit.

These three names belong to `model`; they are defined here so that listing them needs no torch.
"""

AGENTS: Final[tuple[AgentName, ...]] = (
    "ego_vehicle",
    "ego_vehicle_behind",
    "other_vehicle",
    "other_vehicle_behind",
    "infrastructure",
)
INFRASTRUCTURE: Final = "infrastructure"
VEHICLE_AGENTS: Final[tuple[AgentName, ...]] = AGENTS[:4]
"""The agents that are vehicles, in the order of meta's `agents id:` line."""

META_AGENTS: Final[dict[str, AgentName | None]] = {
    "ego": "ego_vehicle",
    "ego_behind": "ego_vehicle_behind",
    "other": "other_vehicle",
    "other_behind": "other_vehicle_behind",
    "none": None,
}
"""Meta's short names of the agents → names of their folders; `none` is a third road user."""

CAMERAS: Final = (
    "Camera_Front",
    "Camera_FrontLeft",
    "Camera_FrontRight",
    "Camera_Back",
    "Camera_BackLeft",
    "Camera_BackRight",
)
LIDAR: Final = "lidar01"
BEV_CAMERA: Final = "BEV_instance_camera"
CHANNELS: Final = (*CAMERAS, LIDAR, BEV_CAMERA)
MODALITIES: Final = ("camera", "lidar", "bev")
CHANNEL_MODALITY: Final[dict[str, str]] = {
    **dict.fromkeys(CAMERAS, "camera"),
    LIDAR: "lidar",
    BEV_CAMERA: "bev",
}
FILE_FORMATS: Final = ("jpg", "npz")
CHANNEL_FORMAT: Final[dict[str, str]] = {
    **dict.fromkeys(CAMERAS, "jpg"),
    LIDAR: "npz",
    BEV_CAMERA: "npz",
}
"""Channel → ending of its files."""

CATEGORIES: Final = ("car", "truck", "van", "cyclist", "motorcycle", "pedestrian")
"""Class names; the index is the class index of the released evaluation.

See docs/released_code.md, Conventions.
"""

SMALL_CATEGORIES: Final = ("cyclist", "motorcycle", "pedestrian")
"""Classes that need fewer LiDAR points to be visible.

See docs/released_code.md, Visibility and attributes.
"""

ACTOR: Final = "actor"
"""Word before an actor's id in the tokens of instances."""
OWN_ACTOR_ID: Final = -100
"""Label id of the recording agent itself."""
UNTRACKED_ID: Final = -1
"""Label id of an actor that is too far away to be tracked; in meta, "no actor"."""
UNKNOWN_ID: Final = 0
"""Meta's id of a collision partner that no label names."""
STATIC_ACTOR_ID: Final = 20000
"""Lowest of the ids of parked vehicles."""
IGNORED_ID: Final = 1_000_000_000
"""Lowest of the ids of actors of unknown classes (nuScenes' buses) in `Dataset.with_ignored`."""

VELOCITY_FRAMES: Final[dict[str, str]] = {
    "released": (
        "the release's own encoding (world velocities rotated once more by the box's "
        "yaw in the LiDAR frame)"
    ),
    "lidar": "the recording agent's LiDAR frame",
    "world": "the world frame",
    "turned-wrong": "the world frame rotated by the agent's yaw with the wrong sign",
    "box": "the box's own frame, x along its length",
}
"""Possible frames of the labels' velocities: first the release's, then other sources'."""
RELEASED_VELOCITY_FRAME: Final = "released"

FRAME_PERIOD: Final = 0.1
"""Seconds between two recorded frames."""
WARM_UP_FRAMES: Final = 10
"""Simulated frames before the recorded ones, which meta counts as well."""

POLE_HEIGHT: Final = 4.0
"""Height of the infrastructure's `ego` origin above the road, metres.

This origin is its LiDAR, on a pole that is 3 to 5 m high in the release. A vehicle's `ego` origin
is on the road.
"""

BEV_SHAPE: Final = (1200, 1200)
BEV_RESOLUTION: Final = 0.1
"""Metres per pixel of the BEV instance camera, which covers ±60 m."""

VERSIONS: Final = ("v1", "v1-mini")
SPLITS: Final = ("train", "val", "test")
MINI_SPLITS: Final = ("train_mini", "val_mini")
"""Subsets of train and val (not the mini release)."""
SPLIT_CHOICES: Final = (*SPLITS, *MINI_SPLITS, "all")
"""Names for `split=`; `all` is every scenario of the release, whatever its split."""
EXPECTED_SCENARIOS: Final[dict[str, int]] = {"train": 483, "val": 104, "test": 104}
EXPECTED_MINI_SCENARIOS: Final = 20

TIMES_OF_DAY: Final = ("Noon", "Sunset", "Night")
WEATHERS: Final = ("Clear", "Cloudy", "HardRain", "MidRain", "SoftRain", "Wet", "WetCloudy")
TOWNS: Final = ("Town01", "Town02", "Town03", "Town04", "Town05", "Town07", "Town10HD")
ROAD_TYPES: Final = ("four-way junction", "three-way junction")
SPAWN_SIDES: Final = ("left", "right", "opposite")
DIRECTIONS: Final = ("straight", "left", "right")
SPAWN_RELATIONS: Final = ("same", "opposite")
CONTACT_SIDES: Final = ("front", "front_side", "rear", "rear_side")
"""The values that occur in the complete release; readers accept others too."""

SCENARIO_ATTRIBUTES: Final = (
    "scenario_type",
    "town",
    "weather",
    "time_of_day",
    "road_type",
    "accident_type",
)
"""The scenario fields that overviews and split reports count by."""


def short_name(agent: str) -> str:
    """Return an agent's short name for headings, such as `ego behind` or `infrastructure`."""
    return agent.replace("_vehicle", "").replace("_", " ")


def frame_timestamp(frame_index: int) -> float:
    """Return the time of a frame in seconds since the first recorded one, which has number 1."""
    return (frame_index - 1) / 10
