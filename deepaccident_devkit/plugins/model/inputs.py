"""The inputs of the model: batches of the devkit as tensors in the model's frame.

The release's model was built in CARLA's left-handed frame (y right). A model with
`handedness="left"` gets all inputs mirrored here, by M = diag(1, −1, 1), and its boxes mirrored
back; its maps have the orientation `released`. No other module depends on the handedness.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import product
from typing import Any, Final, Literal

import torch
from torch import Tensor

from deepaccident_devkit.plugins.model.lift import CameraGeometry
from deepaccident_devkit.plugins.model.warps import six_from_matrices
from deepaccident_devkit.taxonomy import INFRASTRUCTURE, POLE_HEIGHT

Handedness = Literal["left", "right"]
_MIRROR: Final = (1.0, -1.0, 1.0, 1.0)
# Signs of x y z l w h yaw vx vy.
_BOX_MIRROR: Final = (1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0)
# Attributes with one row an ego.
_EGO_ATTRIBUTES: Final = ("ego_rows", "ego_from_agent", "partners")
# Attributes with the agents as their second axis.
_AGENT_ATTRIBUTES: Final = (
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
            present's. None without images.
        cameras: Cameras of these images, (B, A, P, N, …); `rotation` and `translation` are
            `ego_from_camera`, augmented.
        points: All LiDAR points, (K, 4) float32: x y z in metres in the sender's frame, augmented,
            but z above the road; and the intensity. A frame that did not arrive has the present's.
            None without points.
        point_frames: Frame of each point, out of B · A · P, (K,) int64.
        egomotion: 6-vectors `next_from_this` of each agent's own frames, without the augmentation,
            (B, A, P, 6); the last row and the rows of frames that did not arrive are 0.
        frame_valid: Whether each frame, and all later ones, arrived, (B, A, P) bool.
        bev_transform: Augmentation A of all BEV frames, (B, 4, 4).
        ego_rows: The moment and the agent of each ego, (G, 2) int64.
        ego_from_agent: Transforms at the present, augmented, with the link's errors, (G, A, 4, 4).
        partners: The agents that each ego hears, including itself, (G, A) bool.
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
        move = partial(_mapped, lambda tensor: tensor.to(device, non_blocking=True))
        return replace(
            self, **{field.name: move(getattr(self, field.name)) for field in fields(self)}
        )

    def of_egos(self, rows: Tensor) -> ModelInputs:
        """Return the inputs of some egos, without agents that none of them hears.

        Egos are given by their indices (G',) int64.
        """
        selected = replace(self, **{name: getattr(self, name)[rows] for name in _EGO_ATTRIBUTES})
        is_heard = selected.partners.any(0).index_fill(0, selected.ego_rows[:, 1], value=True)
        return selected if is_heard.all() else _of_agents(selected, is_heard)


def model_inputs(
    batch: Mapping[str, Any], handedness: Handedness = "right", *, delay: int = 0
) -> ModelInputs:
    """Return the inputs of a batch with images, points or both.

    Its egos are all of the batch's egos, or each item's first agent.

    Args:
        batch: A batch of `training.torch.collate` or `training.torch.collate_all_egos`.
        handedness: Handedness of the model.
        delay: Age of the partners' data, in frames of 0.1 s (the link's latency).
    """
    arrived = batch["agent_valid"]
    # Frames are joined one after another, so frames before a gap are lost.
    valid = arrived.flip(-1).cumprod(-1).flip(-1).bool()
    source = torch.where(valid, torch.arange(valid.shape[-1]), valid.shape[-1] - 1)
    ego_rows = batch.get("ego_rows")
    if ego_rows is None:
        first_agents = torch.zeros(len(arrived), dtype=torch.int64)
        ego_rows = torch.stack([torch.arange(len(arrived)), first_agents], 1)
    moment, agent = ego_rows.unbind(1)
    # The batch's transforms lead to a common frame of all agents, which need not be an ego's.
    common_from_agent = batch["ego_from_agent"][:, :, -1].double()
    ego_from_common = torch.linalg.inv(common_from_agent[moment, agent])
    ego_from_agent = ego_from_common[:, None] @ common_from_agent[moment]
    heard = batch["partners"] if "partners" in batch else torch.ones_like(arrived[:, :, -1])
    partners = heard & arrived[moment, :, -1]
    ages = torch.full(arrived.shape[:2], delay)
    ages[:, 0] = 0
    is_infrastructure = torch.zeros(arrived.shape[:2], dtype=torch.bool)
    for row, names in zip(is_infrastructure, batch["agents"], strict=True):
        row[: len(names)] = torch.tensor([name == INFRASTRUCTURE for name in names])
    points, point_frames = None, None
    if "points" in batch:
        points, point_frames = _points(batch["points"], source, is_infrastructure, handedness)
    transform = _mirrored(batch["augmentation"].double(), handedness)
    present_from_past = _mirrored(batch["agent_from_past"].double(), handedness)
    has_images = "images" in batch
    return ModelInputs(
        images=_frames_of(batch["images"], source) if has_images else None,
        cameras=_cameras(batch, source, handedness) if has_images else None,
        points=points,
        point_frames=point_frames,
        egomotion=_egomotion(present_from_past, valid, transform),
        frame_valid=valid,
        bev_transform=transform.float(),
        ego_rows=ego_rows,
        ego_from_agent=_mirrored(ego_from_agent, handedness).float(),
        partners=partners,
        is_infrastructure=is_infrastructure,
        delay=ages,
    )


def _of_agents(inputs: ModelInputs, is_selected: Tensor) -> ModelInputs:
    """Return the inputs with some of the agents, (A,) bool, which include all egos."""
    new_index = is_selected.cumsum(0) - 1
    changes = {
        name: _mapped(lambda tensor: tensor[:, is_selected], getattr(inputs, name))
        for name in _AGENT_ATTRIBUTES
    }
    moment, agent = inputs.ego_rows[:, 0], inputs.ego_rows[:, 1]
    changes["ego_rows"] = torch.stack([moment, new_index[agent]], 1)
    if inputs.points is not None and inputs.point_frames is not None:
        frames = inputs.frame_valid.shape[2]
        sender, frame = inputs.point_frames // frames, inputs.point_frames % frames
        moment, agent = sender // len(is_selected), sender % len(is_selected)
        new_sender = moment * int(is_selected.sum()) + new_index[agent]
        is_retained = is_selected[agent]
        changes["points"] = inputs.points[is_retained]
        changes["point_frames"] = (new_sender * frames + frame)[is_retained]
    return replace(inputs, **changes)


def mirrored_boxes(boxes: Tensor, handedness: Handedness) -> Tensor:
    """Return boxes (M, 9), x y z l w h yaw vx vy, of the devkit's frame in the model's.

    The same function maps them back.
    """
    return boxes if handedness == "right" else boxes * boxes.new_tensor(_BOX_MIRROR)


def _cameras(batch: Mapping[str, Any], source: Tensor, handedness: Handedness) -> CameraGeometry:
    """Return the cameras of the images; only the ego side is mirrored, pixels are not."""
    ego_from_camera = _frames_of(batch["ego_from_camera"], source)
    if handedness == "left":
        ego_from_camera = ego_from_camera * ego_from_camera.new_tensor(_MIRROR)[:, None]
    return CameraGeometry(
        rotation=ego_from_camera[..., :3, :3],
        translation=ego_from_camera[..., :3, 3],
        intrinsics=_frames_of(batch["intrinsics"], source),
    )


def _points(
    clouds: Sequence[Sequence[Sequence[Tensor]]],
    source: Tensor,
    is_infrastructure: Tensor,
    handedness: Handedness,
) -> tuple[Tensor, Tensor]:
    """Return all points (K, 4) and their frames (K,).

    Args:
        clouds: Points (N, 4) of each frame of each agent of each of B items.
        source: Index of the frame that each frame is taken from, (B, A, P).
        is_infrastructure: Whether each agent is infrastructure, (B, A) bool.
        handedness: Handedness of the model.
    """
    frames = source.shape[2]
    no_points = torch.zeros((0, 4))
    selected = []
    for item, agent, frame in product(*map(range, source.shape)):
        cloud = no_points
        if agent < len(clouds[item]):
            cloud = clouds[item][agent][int(source[item, agent, frame])]
        selected.append(cloud)
    lengths = torch.tensor([len(cloud) for cloud in selected])
    points = torch.cat([no_points, *selected])
    point_frames = torch.repeat_interleave(lengths)
    # The origin of an infrastructure is on top of its pole.
    points[:, 2] += POLE_HEIGHT * is_infrastructure.flatten()[point_frames // frames]
    if handedness == "left":
        points = points * points.new_tensor(_MIRROR)
    return points, point_frames


def _egomotion(present_from_past: Tensor, valid: Tensor, transform: Tensor) -> Tensor:
    """Return the egomotion (B, A, P, 6) float32 of augmented poses (B, A, P, 4, 4).

    The augmentation has shape (B, 4, 4).
    """
    next_from_this = torch.linalg.inv(present_from_past[:, :, 1:]) @ present_from_past[:, :, :-1]
    inverse_transform = torch.linalg.inv(transform)[:, None, None]
    plain = inverse_transform @ next_from_this @ transform[:, None, None]
    steps = six_from_matrices(plain) * valid[:, :, :-1, None]
    return torch.nn.functional.pad(steps, (0, 0, 0, 1)).float()


def _mirrored(matrices: Tensor, handedness: Handedness) -> Tensor:
    """Return M T M of transforms (…, 4, 4) between frames that are both mirrored."""
    if handedness == "right":
        return matrices
    mirror = matrices.new_tensor(_MIRROR)
    return mirror[:, None] * matrices * mirror


def _frames_of(values: Tensor, source: Tensor) -> Tensor:
    """Return values (B, A, P, …) of the frames `source` (B, A, P)."""
    items, agents = (torch.arange(size) for size in source.shape[:2])
    return values[items[:, None, None], agents[:, None], source]


def _mapped(change: Callable[[Tensor], Tensor], value: Any) -> Any:
    """Return a tensor, or the tensors of cameras, changed; None stays None."""
    if isinstance(value, CameraGeometry):
        tensors = {field.name: change(getattr(value, field.name)) for field in fields(value)}
        return replace(value, **tensors)
    return None if value is None else change(value)
