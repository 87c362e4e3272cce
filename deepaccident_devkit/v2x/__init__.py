"""Agents and their links: who cooperates, what they see together, and where everything is."""

from deepaccident_devkit.v2x.accident_visibility import (
    accident_visibility,
    accident_visible,
    accident_visible_mask,
    pair_in_view,
)
from deepaccident_devkit.v2x.clouds import aggregate_point_cloud
from deepaccident_devkit.v2x.collisions import Contact, collision
from deepaccident_devkit.v2x.configurations import (
    AGENT_CONFIGS,
    AGENT_SETS,
    AVAILABLE,
    AgentConfig,
    Agents,
    cooperating_agents,
)
from deepaccident_devkit.v2x.cooperation import (
    CooperativeView,
    cooperative_boxes,
    cooperative_view,
    visible_instances,
)
from deepaccident_devkit.v2x.link import Link, PoseNoise
from deepaccident_devkit.v2x.messages import MessageSize, message_sizes
from deepaccident_devkit.v2x.poses import future_egomotion, relative_pose_to_ego, transform
from deepaccident_devkit.v2x.projection import ImagePoints, map_pointcloud_to_image, project_to_image
from deepaccident_devkit.v2x.tracks import Trajectory, trajectory

__all__ = [
    "AGENT_CONFIGS",
    "AGENT_SETS",
    "AVAILABLE",
    "AgentConfig",
    "Agents",
    "Contact",
    "CooperativeView",
    "ImagePoints",
    "Link",
    "MessageSize",
    "PoseNoise",
    "Trajectory",
    "accident_visibility",
    "accident_visible",
    "accident_visible_mask",
    "aggregate_point_cloud",
    "collision",
    "cooperating_agents",
    "cooperative_boxes",
    "cooperative_view",
    "future_egomotion",
    "map_pointcloud_to_image",
    "message_sizes",
    "pair_in_view",
    "project_to_image",
    "relative_pose_to_ego",
    "trajectory",
    "transform",
    "visible_instances",
]
