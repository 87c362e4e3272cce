"""The model's door: batches of the devkit become tensors in the model's frame, and what comes out goes back.

The release's model was built in CARLA's left-handed frame (y right). A model with `handedness="left"` gets everything
mirrored here, by M = diag(1, −1, 1), and its boxes mirrored back; its maps lie in the orientation `released`. No other
module asks for it.
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
# Of x y z l w h yaw vx vy.
_BOX_MIRROR: Final = (1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0)
_OF_EGOS: Final = ("ego_rows", "ego_from_agent", "partners")
# Attributes whose second axis is that of the agents.
_OF_AGENTS: Final = (
    "images",
    "cameras",
    "egomotion",
    "frame_valid",
    *_OF_EGOS[1:],
    "is_infrastructure",
    "delay",
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelInputs:
    """What the model sees, in its own frame: B moments of A agents, P frames (the present last), N cameras; G egos.

    Attributes:
        images: (B, A, P, N, 3, h, w) uint8 RGB. A frame that did not arrive has the present's. None for none.
        cameras: of these images, (B, A, P, N, …); `rotation` and `translation` are `ego_from_camera`, augmented.
        points: (K, 4) float32, all LiDAR points: x y z in metres in the sender's frame, augmented, but z above the
            road; and the intensity. A frame that did not arrive has the present's. None for none.
        point_frames: (K,) int64, the frame of each point, of the B · A · P ones.
        egomotion: (B, A, P, 6) `next_from_this` of each agent's own frames, without the augmentation; the last row,
            and those of frames that did not arrive, are 0.
        frame_valid: (B, A, P) bool: the frames that arrived, up to the present without a gap.
        bev_transform: (B, 4, 4) the augmentation A of all BEV frames.
        ego_rows: (G, 2) int64: the moment and the agent that each ego is.
        ego_from_agent: (G, A, 4, 4) at the present, augmented, with the link's errors.
        partners: (G, A) bool: who is heard by each ego, itself included.
        is_infrastructure: (B, A) bool.
        delay: (B, A) int64: how old the data are, in frames of 0.1 s.
    """

    images: Tensor | None = None
    cameras: CameraGeometry | None = None
    points: Tensor | None = None
    point_frames: Tensor | None = None
    egomotion: Tensor
    frame_valid: Tensor
    bev_transform: Tensor
    ego_rows: Tensor
    ego_from_agent: Tensor
    partners: Tensor
    is_infrastructure: Tensor
    delay: Tensor

    def to(self, device: torch.device | str) -> ModelInputs:
        """The same on another device."""
        moved = partial(_mapped, lambda each: each.to(device, non_blocking=True))
        return replace(
            self, **{each.name: moved(getattr(self, each.name)) for each in fields(self)}
        )

    def of_egos(self, rows: Tensor) -> ModelInputs:
        """The same with some egos, by their positions (G',) int64, and without agents that none of them hears."""
        some = replace(self, **{name: getattr(self, name)[rows] for name in _OF_EGOS})
        heard = some.partners.any(0).index_fill(0, some.ego_rows[:, 1], value=True)
        return some if heard.all() else _of_agents(some, heard)


def model_inputs(
    batch: Mapping[str, Any], handedness: Handedness = "right", *, delay: int = 0
) -> ModelInputs:
    """The inputs of a batch with images, points or both, of all its egos, or with each item's first agent as the ego.

    Args:
        batch: of `training.torch.collate` or `training.torch.collate_all_egos`.
        handedness: the model's.
        delay: how old the partners' data are, in frames of 0.1 s (the link's latency).
    """
    arrived = batch["agent_valid"]
    # frames are joined one after another: what lies before a gap is lost
    valid = arrived.flip(-1).cumprod(-1).flip(-1).bool()
    source = torch.where(valid, torch.arange(valid.shape[-1]), valid.shape[-1] - 1)
    rows = batch.get("ego_rows")
    if rows is None:
        rows = torch.stack(
            [torch.arange(len(arrived)), torch.zeros(len(arrived), dtype=torch.int64)], 1
        )
    moment, agent = rows.unbind(1)
    present = batch["ego_from_agent"][:, :, -1].double()
    ego_from_agent = torch.linalg.inv(present[moment, agent])[:, None] @ present[moment]
    heard = batch["partners"] if "partners" in batch else torch.ones_like(arrived[:, :, -1])
    partners = heard & arrived[moment, :, -1]
    ages = torch.full(arrived.shape[:2], delay)
    ages[:, 0] = 0
    roadside = torch.zeros(arrived.shape[:2], dtype=torch.bool)
    for row, names in zip(roadside, batch["agents"], strict=True):
        row[: len(names)] = torch.tensor([name == INFRASTRUCTURE for name in names])
    points, point_frames = (
        _points(batch["points"], source, roadside, handedness)
        if "points" in batch
        else (None, None)
    )
    transform = _mirrored(batch["augmentation"].double(), handedness)
    return ModelInputs(
        images=_taken(batch["images"], source) if "images" in batch else None,
        cameras=_cameras(batch, source, handedness) if "images" in batch else None,
        points=points,
        point_frames=point_frames,
        egomotion=_egomotion(
            _mirrored(batch["agent_from_past"].double(), handedness), valid, transform
        ),
        frame_valid=valid,
        bev_transform=transform.float(),
        ego_rows=rows,
        ego_from_agent=_mirrored(ego_from_agent, handedness).float(),
        partners=partners,
        is_infrastructure=roadside,
        delay=ages,
    )


def _of_agents(inputs: ModelInputs, kept: Tensor) -> ModelInputs:
    """The inputs with some of the agents, (A,) bool, among them all egos."""
    place = kept.cumsum(0) - 1
    changes = {
        name: _mapped(lambda each: each[:, kept], getattr(inputs, name)) for name in _OF_AGENTS
    }
    changes["ego_rows"] = torch.stack([inputs.ego_rows[:, 0], place[inputs.ego_rows[:, 1]]], 1)
    if inputs.points is not None and inputs.point_frames is not None:
        frames = inputs.frame_valid.shape[2]
        sender, frame = inputs.point_frames // frames, inputs.point_frames % frames
        moment, agent = sender // len(kept), sender % len(kept)
        there = kept[agent]
        changes["points"] = inputs.points[there]
        changes["point_frames"] = (((moment * int(kept.sum())) + place[agent]) * frames + frame)[
            there
        ]
    return replace(inputs, **changes)


def mirrored_boxes(boxes: Tensor, handedness: Handedness) -> Tensor:
    """Boxes (M, 9), x y z l w h yaw vx vy, from the devkit's frame to the model's, or back."""
    return boxes if handedness == "right" else boxes * boxes.new_tensor(_BOX_MIRROR)


def _cameras(batch: Mapping[str, Any], source: Tensor, handedness: Handedness) -> CameraGeometry:
    """The cameras of the images; only the ego side is mirrored, pixels are not."""
    ego_from_camera = _taken(batch["ego_from_camera"], source)
    if handedness == "left":
        ego_from_camera = ego_from_camera * ego_from_camera.new_tensor(_MIRROR)[:, None]
    return CameraGeometry(
        rotation=ego_from_camera[..., :3, :3],
        translation=ego_from_camera[..., :3, 3],
        intrinsics=_taken(batch["intrinsics"], source),
    )


def _points(
    clouds: Sequence[Sequence[Sequence[Tensor]]],
    source: Tensor,
    roadside: Tensor,
    handedness: Handedness,
) -> tuple[Tensor, Tensor]:
    """All points (K, 4) and their frames (K,) of B items' agents' clouds (N, 4), from the frames `source` (B, A, P)."""
    frames = source.shape[2]
    none = torch.zeros((0, 4))
    given = [
        clouds[item][agent][int(source[item, agent, frame])] if agent < len(clouds[item]) else none
        for item, agent, frame in product(*map(range, source.shape))
    ]
    lengths = torch.tensor([len(cloud) for cloud in given])
    points = torch.cat([none, *given])
    point_frames = torch.repeat_interleave(lengths)
    # the origin of an infrastructure is on top of its pole
    points[:, 2] += POLE_HEIGHT * roadside.flatten()[point_frames // frames]
    return (points if handedness == "right" else points * points.new_tensor(_MIRROR)), point_frames


def _egomotion(present_from_past: Tensor, valid: Tensor, transform: Tensor) -> Tensor:
    """(B, A, P, 6) float32 from augmented poses (B, A, P, 4, 4) and the augmentation (B, 4, 4)."""
    before = torch.linalg.inv(present_from_past[:, :, 1:]) @ present_from_past[:, :, :-1]
    plain = torch.linalg.inv(transform)[:, None, None] @ before @ transform[:, None, None]
    steps = six_from_matrices(plain) * valid[:, :, :-1, None]
    return torch.nn.functional.pad(steps, (0, 0, 0, 1)).float()


def _mirrored(matrices: Tensor, handedness: Handedness) -> Tensor:
    """M T M of transforms (…, 4, 4) between frames that are both mirrored."""
    if handedness == "right":
        return matrices
    mirror = matrices.new_tensor(_MIRROR)
    return mirror[:, None] * matrices * mirror


def _taken(values: Tensor, source: Tensor) -> Tensor:
    """Values (B, A, P, …) of the frames `source` (B, A, P)."""
    first, second = (torch.arange(size) for size in source.shape[:2])
    return values[first[:, None, None], second[:, None], source]


def _mapped(change: Callable[[Tensor], Tensor], value: Any) -> Any:
    """A tensor, or those of cameras, changed; None is None."""
    if isinstance(value, CameraGeometry):
        return replace(
            value, **{each.name: change(getattr(value, each.name)) for each in fields(value)}
        )
    return None if value is None else change(value)
