"""Items of a `V2XDataset`, batches of them for a DataLoader, and a merge of several ranks' counts.

Training on several ranks needs no other part of the devkit: `V2XDataset` draws augmentations by
index and epoch, so ranks that take different indices from torch's `DistributedSampler` draw
different augmentations.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import compress
from multiprocessing.reduction import ForkingPickler
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.errors import ConfigError, EvaluationError
from deepaccident_devkit.evaluation.evaluator import Evaluator, EvaluatorT
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import AGENTS

if TYPE_CHECKING:
    from torch import Tensor
    from torch.distributed import ProcessGroup

_MATRICES = (
    "ego_from_agent",
    "agent_from_past",
    "intrinsics",
    "ego_from_camera",
    "image_from_ego",
)
# Keys of tensors with the agents as their first axis.
_AGENT_KEYS = ("agent_valid", "files_missing", "images", *_MATRICES)
_BOX_KEYS = ("boxes", "velocity_known", "categories", "actor_ids", "window")
# Keys that stay lists with one entry for each item: texts, and tensors of different lengths.
_LIST_KEYS = ("token", "agents", "points", *_BOX_KEYS)
# Keys that only items of an `AllEgosDataset` have.
_EGO_KEYS = ("egos", "partners", "targets")
# Largest size of a tensor that is copied, because shared memory takes 1 ms to set up.
_MAX_COPIED_BYTES = 1 << 16


class V2XItem(dict[str, Any]):
    """An item of a `V2XDataset`: a dict with a short text, which torch batches by `collate`."""

    def __repr__(self) -> str:
        """Return the item's token and agents, and the names of its other contents."""
        token = self.get("token")
        agents = self.get("agents")
        names = [name for name in self if name not in ("token", "agents")]
        return f"V2XItem({token}, agents {agents}: {', '.join(names)})"


class _WorkersBatch(dict[str, Any]):
    """A batch in a worker, which becomes a dict in the process that receives it."""


def collate(items: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return B items as one dict with an axis of agents.

    It is for models with a fixed number of agents, or with a mask for them. `token`, `agents`,
    `points`, the boxes (`boxes`, `velocity_known`, `categories`, `actor_ids`) and `window` of the
    items (`V2XDataset`) become lists of B. All other tensors are stacked, (B, …). If items have
    different numbers of agents, tensors (B, A, …) are padded with blank agents, which have
    `agent_valid` False, images of 0 and identity matrices.

    Raises:
        ConfigError: If there are no items, or they do not fit together because of different
            configurations or image sizes.
    """
    from torch.utils.data import get_worker_info

    _check_alike(items)
    agent_count = max(len(item["agents"]) for item in items)
    batch: NamedValues = {} if get_worker_info() is None else _WorkersBatch()
    for key in items[0]:
        values = [item[key] for item in items]
        if key in _LIST_KEYS:
            batch[key] = values
        else:
            if key in _AGENT_KEYS:
                values = [_with_agents(key, value, agent_count) for value in values]
            batch[key] = _joined(key, [value[None] for value in values])
    return batch


def collate_fusion(items: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return B items as one dict with the agents of all items one after another.

    It is for V2X fusion models such as OpenCOOD's. Agents with no data at the present are
    left out (for the other agents, `agent_valid` still marks missing past data); the sample's own
    agent is always the first of its item. N is the number of remaining agents in the batch. The
    dict is as in `collate`, but tensors of agents are (N, …) instead of (B, A, …), `points` is a
    list of N, and `agents` is a list of B tuples of names. In addition:

    - `record_len` (B,) int64: number of agents of each item; the sum is N.
    - `pairwise_t_matrix` (B, L, L, 4, 4) float32, L = 5: [b, i, j] converts points of agent i's ego
      frame to agent j's, `j_from_i` = `ego_from_j`⁻¹ · `ego_from_i`, at the present, so that [b, i,
      0] leads to the sample's own ego frame. It is augmented like the points, with the link's
      errors; it is the identity on the diagonal and beyond `record_len`.

    The frames of OpenCOOD are the LiDARs' frames, left-handed like CARLA's; the frames here are ego
    frames, right-handed.

    Raises:
        ConfigError: If there are no items, or they do not fit together because of different
            configurations or image sizes.
    """
    import torch

    _check_alike(items)
    batch = collate([_without_keys(item, _AGENT_KEYS) for item in items])
    masks = [item["agent_valid"][:, -1] for item in items]
    for key in _AGENT_KEYS:
        if key in items[0]:
            parts = [item[key][mask] for item, mask in zip(items, masks, strict=True)]
            batch[key] = _joined(key, parts)
    names = []
    clouds: list[Any] = []
    transforms = []
    for item, mask in zip(items, masks, strict=True):
        names.append(tuple(compress(item["agents"], mask)))
        clouds += compress(item.get("points", ()), mask)
        transforms.append(_pairwise_transforms(item["ego_from_agent"][mask, -1]))
    batch["agents"] = names
    if "points" in batch:
        batch["points"] = clouds
    batch["record_len"] = torch.tensor([len(item_names) for item_names in names])
    batch["pairwise_t_matrix"] = torch.stack(transforms)
    return batch


def collate_all_egos(items: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return B moments as one dict, with an axis of the G egos of all moments one after another.

    Sensor data are as in `collate`, (B, A, …). In addition:

    - `egos`: list of G tokens. `ego_rows` (G, 2) int64: the item and the agent of each ego.
    - `partners` (G, A) bool: the agents of the ego's item that cooperate with the ego.
    - the targets: stacked, (G, …), or lists of G for boxes and windows.

    Raises:
        ConfigError: As in `collate`.
    """
    import torch

    _check_alike(items)
    batch = collate([_without_keys(item, _EGO_KEYS) for item in items])
    agent_count = max(len(item["agents"]) for item in items)
    egos = []
    ego_rows = []
    partners = []
    targets = []
    for index, item in enumerate(items):
        for ego in item["egos"]:
            _, agent, _ = ego.rsplit("/", 2)
            egos.append(ego)
            ego_rows.append((index, item["agents"].index(agent)))
        missing_count = agent_count - len(item["agents"])
        partners.append(torch.nn.functional.pad(item["partners"], (0, missing_count)))
        targets += item["targets"]
    batch["egos"] = egos
    batch["ego_rows"] = torch.tensor(ego_rows, dtype=torch.int64).reshape(-1, 2)
    batch["partners"] = torch.cat(partners)
    for key in targets[0]:
        values = [target[key] for target in targets]
        batch[key] = values if key in _BOX_KEYS else torch.stack(values)
    return batch


def _without_keys(item: NamedValues, keys: Sequence[str]) -> NamedValues:
    """Return an item without some keys."""
    remaining_keys = [key for key in item if key not in keys]
    return {key: item[key] for key in remaining_keys}


def _collate_by_default(items: Sequence[V2XItem], **_: object) -> NamedValues:
    """Collate with `collate` or, for all egos, `collate_all_egos`; torch calls this for items."""
    if "egos" in items[0]:
        return collate_all_egos(items)
    return collate(items)


with suppress(ImportError):  # torch's documented registry, which has no public module
    from torch.utils.data._utils.collate import default_collate_fn_map

    # The documentation's mock of torch does not support assignment by key.
    default_collate_fn_map.update({V2XItem: _collate_by_default})


class _ByValue:
    """A small tensor, sent as a copied array; larger tensors are sent in shared memory."""

    def __init__(self, array: AnyArray) -> None:
        self._array = array

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the tensor itself when it is unpickled."""
        import torch

        return torch.from_numpy, (self._array,)


def _sendable(value: Any) -> Any:
    """Return a part of an item or a batch in the form in which a worker sends it."""
    import torch

    if type(value) in (list, tuple):
        return type(value)(map(_sendable, value))
    if isinstance(value, dict):
        return {key: _sendable(part) for key, part in value.items()}
    if isinstance(value, torch.Tensor) and value.nbytes <= _MAX_COPIED_BYTES:
        # numpy may lack the tensor's type, or the tensor may be on a GPU or have a gradient
        with suppress(TypeError, RuntimeError):
            return _ByValue(value.numpy())
    return value


ForkingPickler.register(V2XItem, lambda item: (V2XItem, (_sendable(item),)))
ForkingPickler.register(_WorkersBatch, lambda batch: (dict, (_sendable(batch),)))


def _check_alike(items: Sequence[NamedValues]) -> None:
    """Check that there is an item, and that all items have the same keys; raises ConfigError."""
    if not items:
        raise ConfigError("batch: expected at least one item, found none")
    for item in items[1:]:
        differing = sorted(item.keys() ^ items[0].keys())
        if differing:
            raise ConfigError(
                f"batch: only some of the items have {differing[0]!r}; batch items of one "
                "V2XConfig at a time"
            )


def _joined(key: str, parts: Sequence[Tensor]) -> Tensor:
    """Return tensors (n, …) joined along their first axis, (N, …); a single one is not copied.

    Raises:
        ConfigError: If other axes differ.
    """
    import torch
    from torch.utils.data import default_collate

    sizes = sorted({tuple(part.shape[1:]) for part in parts})
    if len(sizes) > 1:
        remedy = "choose resize=" if key == "images" else "batch items of one V2XConfig at a time"
        raise ConfigError(
            f"{key}: items of shapes {sizes[0]} and {sizes[-1]} cannot form a batch; {remedy}"
        )
    if len(parts) == 1:
        return parts[0]
    if len({len(part) for part in parts}) == 1:
        stacked: Tensor = default_collate(list(parts))  # in a worker, straight into shared memory
        return stacked.flatten(0, 1)
    return torch.cat(list(parts))


def _pairwise_transforms(ego_from_agent: Tensor) -> Tensor:
    """Return the transforms (L, L, 4, 4) between n agents, padded with identity matrices.

    Args:
        ego_from_agent: (n, 4, 4) poses of the agents.
    """
    import torch

    count = len(ego_from_agent)
    poses = ego_from_agent.double()
    inverse_poses = torch.linalg.inv(poses)
    transforms = torch.eye(4).repeat(len(AGENTS), len(AGENTS), 1, 1)
    transforms[:count, :count] = (inverse_poses[None, :] @ poses[:, None]).float()
    transforms[range(count), range(count)] = torch.eye(4)
    return transforms


def _with_agents(key: str, value: Tensor, count: int) -> Tensor:
    """Return a tensor (A, …) with blank agents at the end, up to a number of agents."""
    import torch

    missing_count = count - len(value)
    if not missing_count:
        return value
    blank = torch.zeros((missing_count, *value.shape[1:]), dtype=value.dtype)
    if key in _MATRICES:
        blank[...] = torch.eye(value.shape[-1])
    return torch.cat([value, blank])


def merged_evaluator(evaluator: EvaluatorT, group: ProcessGroup | None = None) -> EvaluatorT:
    """Return all ranks' counts in one new evaluator, on every rank; all ranks must call it.

    Counts are small and stored by token, and are summed exactly: the result is bit for bit
    the same as if one process counted all samples. A sample that several ranks counted equally, as
    after `DistributedSampler`, counts once (`Evaluator.repeated`).

    Args:
        evaluator: This rank's evaluator, which is not changed.
        group: Group of the processes that take part; None for all. With NCCL, objects go over the
            GPUs, so each process first needs `torch.cuda.set_device`; a group with `gloo` needs no
            GPU.

    Returns:
        An evaluator with all samples; a copy of this evaluator if `torch.distributed` was not set
        up.

    Raises:
        EvaluationError: On all ranks, if one rank passed no evaluator or an evaluator of other
            settings, or two ranks counted the same sample differently.
    """
    from torch import distributed

    evaluators: list[Any] = [evaluator]
    if distributed.is_available() and distributed.is_initialized():
        evaluators = [None] * distributed.get_world_size(group)
        distributed.all_gather_object(evaluators, evaluator, group)
    for rank, rank_evaluator in enumerate(evaluators):
        if not isinstance(rank_evaluator, Evaluator):
            raise EvaluationError(
                f"evaluator: expected an Evaluator, such as MotionEvaluator(), but rank {rank} "
                f"has {rank_evaluator!r}"
            )
    merged: EvaluatorT = evaluators[0].fresh()
    for rank_evaluator in evaluators:
        merged.merge(rank_evaluator)
    return merged
