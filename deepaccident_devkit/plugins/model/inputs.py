"""The model's inputs: the devkit's batches as tensors in the model's frame.

The release's model was built in CARLA's left-handed frame (y right). A model with
`handedness="left"` gets all inputs mirrored here, by M = diag(1, −1, 1), and its boxes mirrored
back; its maps have the orientation `released`. No other module depends on the handedness.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import product
from typing import Any, Literal

import torch
from torch import Tensor

from deepaccident_devkit.plugins.model.lift import CameraGeometry
from deepaccident_devkit.plugins.model.warps import six_from_matrices
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.taxonomy import INFRASTRUCTURE, POLE_HEIGHT

Handedness = Literal["left", "right"]
_MIRROR = (1.0, -1.0, 1.0, 1.0)
# Signs of x y z l w h yaw vx vy.
_BOX_MIRROR = (1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0)
# Attributes that have one row per ego.
_EGO_ATTRIBUTES = ("ego_rows", "ego_from_agent", "partners")
# Attributes whose second axis is the agents.
_AGENT_ATTRIBUTES = (
    "images",
    "cameras",
    "egomotion",
    "frame_valid",
    *_EGO_ATTRIBUTES[1:],
    "is_infrastructure",
    "delay",
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelInputs:
    """The inputs of the model, in its own frame.

    There are B moments of A agents, P frames (the present last), N cameras, and G egos.

    Attributes:
        images: RGB images, (B, A, P, N, 3, h, w) uint8. A frame that did not arrive has the
            present's images. None for a model without cameras.
        cameras: Cameras of these images, (B, A, P, N, …); `rotation` and `translation` are
            `ego_from_camera`, augmented.
        points: All LiDAR points, (K, 4) float32: x, y, z and intensity; x and y in metres in the
            sender's augmented frame, z in metres above the road. A frame that did not arrive has
            the present's points. None for a model without LiDAR.
        point_frames: Index of each point's frame among B · A · P frames, (K,) int64.
        egomotion: 6-vectors `next_from_this` between each agent's consecutive frames, not
            augmented, (B, A, P, 6); the last row and the rows of frames that did not arrive are 0.
        frame_valid: Whether each frame, and all later ones, arrived, (B, A, P) bool.
        bev_transform: Augmentation A of all BEV frames, (B, 4, 4).
        ego_rows: The moment and the agent of each ego, (G, 2) int64.
        ego_from_agent: Transforms at the present, augmented, with the link's errors, (G, A, 4, 4).
        partners: Whether each ego receives each agent's data; true for the ego itself, (G, A) bool.
        is_infrastructure: Whether each agent is infrastructure, (B, A) bool.
        delay: Age of the data in frames of 0.1 s, (B, A) int64.
    """

    # Sensors.
    images: Tensor | None = None
    cameras: CameraGeometry | None = None
    points: Tensor | None = None
    point_frames: Tensor | None = None
    # Frames.
    egomotion: Tensor
    frame_valid: Tensor
    bev_transform: Tensor
    # Egos and their partners.
    ego_rows: Tensor
    ego_from_agent: Tensor
    partners: Tensor
    is_infrastructure: Tensor
    delay: Tensor

    def to(self, device: torch.device | str) -> ModelInputs:
        """Return the same inputs on another device."""
        changes = {}
        for field in fields(self):
            value = getattr(self, field.name)
            changes[field.name] = _map_tensors(partial(_move_tensor, device), value)
        return replace(self, **changes)

    def of_egos(self, rows: Tensor) -> ModelInputs:
        """Return the inputs of some egos, without agents from which none of them receives data.

        `rows` are the egos' indices, (G',) int64.
        """
        changes = {}
        for name in _EGO_ATTRIBUTES:
            changes[name] = getattr(self, name)[rows]
        selected = replace(self, **changes)
        is_partner = selected.partners.any(0)
        is_needed = is_partner.index_fill(0, selected.ego_rows[:, 1], value=True)
        if is_needed.all():
            return selected
        return _select_agents(selected, is_needed)


def model_inputs(
    batch: Mapping[str, Any], handedness: Handedness = "right", *, delay: int = 0
) -> ModelInputs:
    """Convert a batch with images, points or both to the model's inputs.

    The egos are all egos of the batch, or each item's first agent if the batch names none.

    Args:
        batch: A batch of `training.torch.collate` or `training.torch.collate_all_egos`.
        handedness: Handedness of the model.
        delay: Age of the partners' data, in frames of 0.1 s (the link's latency).
    """
    arrived = batch["agent_valid"]
    # Frames are chained one after another, so frames before a gap are lost.
    valid = arrived.flip(-1).cumprod(-1).flip(-1).bool()
    source = torch.where(valid, torch.arange(valid.shape[-1]), valid.shape[-1] - 1)
    ego_rows = batch.get("ego_rows")
    if ego_rows is None:
        first_agents = torch.zeros(len(arrived), dtype=torch.int64)
        ego_rows = torch.stack([torch.arange(len(arrived)), first_agents], 1)
    moment, agent = ego_rows.unbind(1)
    # The batch's transforms lead to a frame common to all agents, which need not be an ego's.
    common_from_agent = batch["ego_from_agent"][:, :, -1].double()
    ego_from_common = torch.linalg.inv(common_from_agent[moment, agent])
    ego_from_agent = ego_from_common[:, None] @ common_from_agent[moment]
    partners = arrived[moment, :, -1]
    if "partners" in batch:
        partners = batch["partners"] & partners
    ages = torch.full(arrived.shape[:2], delay)
    ages[:, 0] = 0
    is_infrastructure = torch.zeros(arrived.shape[:2], dtype=torch.bool)
    for item, names in enumerate(batch["agents"]):
        for number, name in enumerate(names):
            is_infrastructure[item, number] = name == INFRASTRUCTURE
    points = None
    point_frames = None
    if "points" in batch:
        points, point_frames = _join_clouds(batch["points"], source, is_infrastructure, handedness)
    images = None
    cameras = None
    if "images" in batch:
        images = _select_frames(batch["images"], source)
        cameras = _select_cameras(batch, source, handedness)
    transform = _mirror(batch["augmentation"].double(), handedness)
    present_from_past = _mirror(batch["agent_from_past"].double(), handedness)
    return ModelInputs(
        images=images,
        cameras=cameras,
        points=points,
        point_frames=point_frames,
        egomotion=_compute_egomotion(present_from_past, valid, transform),
        frame_valid=valid,
        bev_transform=transform.float(),
        ego_rows=ego_rows,
        ego_from_agent=_mirror(ego_from_agent, handedness).float(),
        partners=partners,
        is_infrastructure=is_infrastructure,
        delay=ages,
    )


def _select_agents(inputs: ModelInputs, is_selected: Tensor) -> ModelInputs:
    """Return the inputs of the selected agents, (A,) bool; all egos must be among them."""
    new_index = is_selected.cumsum(0) - 1
    changes = {}
    for name in _AGENT_ATTRIBUTES:
        value = getattr(inputs, name)
        changes[name] = _map_tensors(lambda tensor: tensor[:, is_selected], value)
    ego_rows = inputs.ego_rows.clone()
    ego_rows[:, 1] = new_index[ego_rows[:, 1]]
    changes["ego_rows"] = ego_rows
    if inputs.points is not None and inputs.point_frames is not None:
        frames = inputs.frame_valid.shape[2]
        sender = inputs.point_frames // frames
        frame = inputs.point_frames % frames
        moment = sender // len(is_selected)
        agent = sender % len(is_selected)
        num_selected = int(is_selected.sum())
        new_sender = moment * num_selected + new_index[agent]
        new_frames = new_sender * frames + frame
        is_retained = is_selected[agent]
        changes["points"] = inputs.points[is_retained]
        changes["point_frames"] = new_frames[is_retained]
    return replace(inputs, **changes)


def mirrored_boxes(boxes: Tensor, handedness: Handedness) -> Tensor:
    """Transform boxes (M, 9: x y z l w h yaw vx vy) from the devkit's frame to the model's.

    The mapping is its own inverse.
    """
    if handedness == "right":
        return boxes
    return boxes * boxes.new_tensor(_BOX_MIRROR)


def _select_cameras(
    batch: ReadOnlyValues, source: Tensor, handedness: Handedness
) -> CameraGeometry:
    """Return the cameras of the images; only the ego frame is mirrored, the pixels are not."""
    ego_from_camera = _select_frames(batch["ego_from_camera"], source)
    if handedness == "left":
        mirror = ego_from_camera.new_tensor(_MIRROR)[:, None]
        ego_from_camera = ego_from_camera * mirror
    return CameraGeometry(
        rotation=ego_from_camera[..., :3, :3],
        translation=ego_from_camera[..., :3, 3],
        intrinsics=_select_frames(batch["intrinsics"], source),
    )


def _join_clouds(
    clouds: Sequence[Sequence[Sequence[Tensor]]],
    source: Tensor,
    is_infrastructure: Tensor,
    handedness: Handedness,
) -> tuple[Tensor, Tensor]:
    """Concatenate all points (K, 4), and return them with the index of each point's frame (K,).

    Args:
        clouds: Points (N, 4), indexed by item, agent and frame.
        source: Index of the frame that each frame is taken from, (B, A, P).
        is_infrastructure: Whether each agent is infrastructure, (B, A) bool.
        handedness: Handedness of the model.
    """
    frames = source.shape[2]
    no_points = torch.zeros((0, 4))
    frame_clouds = []
    for item, agent, frame in product(*map(range, source.shape)):
        cloud = no_points
        if agent < len(clouds[item]):
            source_frame = int(source[item, agent, frame])
            cloud = clouds[item][agent][source_frame]
        frame_clouds.append(cloud)
    lengths = torch.tensor([len(cloud) for cloud in frame_clouds])
    points = torch.cat([no_points, *frame_clouds])
    point_frames = torch.repeat_interleave(lengths)
    # The origin of an infrastructure's frame is on top of its pole.
    is_on_pole = is_infrastructure.flatten()[point_frames // frames]
    points[:, 2] += POLE_HEIGHT * is_on_pole
    if handedness == "left":
        points = points * points.new_tensor(_MIRROR)
    return points, point_frames


def _compute_egomotion(present_from_past: Tensor, valid: Tensor, transform: Tensor) -> Tensor:
    """Return the egomotion (B, A, P, 6) float32 of augmented poses (B, A, P, 4, 4).

    The augmentation `transform` has shape (B, 4, 4), `valid` (B, A, P).
    """
    present_from_next = present_from_past[:, :, 1:]
    next_from_this = torch.linalg.inv(present_from_next) @ present_from_past[:, :, :-1]
    transform = transform[:, None, None]
    unaugmented = torch.linalg.inv(transform) @ next_from_this @ transform
    six_vectors = six_from_matrices(unaugmented)
    steps = six_vectors * valid[:, :, :-1, None]
    return torch.nn.functional.pad(steps, (0, 0, 0, 1)).float()


def _mirror(matrices: Tensor, handedness: Handedness) -> Tensor:
    """Return M T M for transforms T (…, 4, 4), where both frames are mirrored by M."""
    if handedness == "right":
        return matrices
    mirror = matrices.new_tensor(_MIRROR)
    return mirror[:, None] * matrices * mirror


def _select_frames(values: Tensor, source: Tensor) -> Tensor:
    """Take each frame of values (B, A, P, …) from the frame that `source` (B, A, P) names."""
    items, agents, _ = source.shape
    item = torch.arange(items)[:, None, None]
    agent = torch.arange(agents)[:, None]
    return values[item, agent, source]


def _move_tensor(device: torch.device | str, tensor: Tensor) -> Tensor:
    """Return a tensor on another device, without waiting for the copy."""
    return tensor.to(device, non_blocking=True)


def _map_tensors(change: Callable[[Tensor], Tensor], value: Any) -> Any:
    """Apply a function to a tensor, or to all tensors of cameras; return None for None."""
    if value is None:
        return None
    if isinstance(value, Tensor):
        return change(value)
    tensors = {field.name: change(getattr(value, field.name)) for field in fields(value)}
    return CameraGeometry(**tensors)
