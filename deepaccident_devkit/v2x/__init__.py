"""Agents and their radio links: cooperation, merged views, poses, tracks and accidents."""

from deepaccident_devkit.v2x.agent_motion import MIN_CURVATURE_SPEED, AgentMotion, agent_motion
from deepaccident_devkit.v2x.agents import (
    AGENT_CONFIGS,
    AGENT_SETS,
    AVAILABLE,
    AgentConfig,
    Agents,
    accident_visibility,
    accident_visible,
    accident_visible_mask,
    cooperating_agents,
    hidden_collider,
    pair_in_view,
)
from deepaccident_devkit.v2x.clouds import aggregate_point_cloud
from deepaccident_devkit.v2x.collisions import Contact, collision
from deepaccident_devkit.v2x.cooperation import (
    CooperativeView,
    cooperative_boxes,
    cooperative_view,
    visible_instances,
)
from deepaccident_devkit.v2x.messages import Link, MessageSize, PoseNoise, message_sizes
from deepaccident_devkit.v2x.poses import (
    ImagePoints,
    future_egomotion,
    map_pointcloud_to_image,
    project_to_image,
    relative_pose_to_ego,
    transform,
)
from deepaccident_devkit.v2x.track_window import TrackWindow, stack_windows
from deepaccident_devkit.v2x.tracks import Trajectory, trajectory
from deepaccident_devkit.v2x.windows import WindowConfig, window, windows

__all__ = [
    "AGENT_CONFIGS",
    "AGENT_SETS",
    "AVAILABLE",
    "MIN_CURVATURE_SPEED",
    "AgentConfig",
    "AgentMotion",
    "Agents",
    "Contact",
    "CooperativeView",
    "ImagePoints",
    "Link",
    "MessageSize",
    "PoseNoise",
    "TrackWindow",
    "Trajectory",
    "WindowConfig",
    "accident_visibility",
    "accident_visible",
    "accident_visible_mask",
    "agent_motion",
    "aggregate_point_cloud",
    "collision",
    "cooperating_agents",
    "cooperative_boxes",
    "cooperative_view",
    "future_egomotion",
    "hidden_collider",
    "map_pointcloud_to_image",
    "message_sizes",
    "pair_in_view",
    "project_to_image",
    "relative_pose_to_ego",
    "stack_windows",
    "trajectory",
    "transform",
    "visible_instances",
    "window",
    "windows",
]
