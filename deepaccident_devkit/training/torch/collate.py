"""Items of a `V2XDataset`, batches of them for a DataLoader's `collate_fn`, and one evaluator of several ranks' counts.

Training on several ranks needs nothing else of the devkit's: `V2XDataset` draws augmentations by position and epoch, so
ranks that take different positions from torch's `DistributedSampler` draw different ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.reduction import ForkingPickler
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.errors import ConfigError, EvaluationError
from deepaccident_devkit.evaluation.evaluator import Evaluator, EvaluatorT
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.taxonomy import AGENTS

if TYPE_CHECKING:
    from torch import Tensor
    from torch.distributed import ProcessGroup

_MATRICES: Final = (
    "ego_from_agent",
    "agent_from_past",
    "intrinsics",
    "ego_from_camera",
    "image_from_ego",
)
# Tensors whose first axis counts agents.
_OF_AGENTS: Final = ("agent_valid", "files_missing", "images", *_MATRICES)
_OF_BOXES: Final = ("boxes", "velocity_known", "categories", "actor_ids")
# Keys that stay lists with one entry for each item: texts, and tensors of different lengths.
_LISTS: Final = ("token", "agents", "points", *_OF_BOXES)
# Keys of `AllEgosDataset` items alone.
_OF_EGOS: Final = ("egos", "partners", "targets")


class V2XItem(dict[str, Any]):
    """An item of a `V2XDataset`: a dict that prints in a line, and that a DataLoader without `collate_fn` can batch."""

    def __repr__(self) -> str:
        """Its token, its agents, and the names of what else it holds."""
        others = [name for name in self if name not in ("token", "agents")]
        return f"V2XItem({self.get('token')}, agents {self.get('agents')}: {', '.join(others)})"


class _WorkersBatch(dict[str, Any]):
    """A batch in a worker, which its receiver gets as a dict."""


def collate(items: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """B items as one dict with an axis of agents: for models with a fixed number of agents, or with a mask for them.

    `token`, `agents`, `points` and the boxes (`boxes`, `velocity_known`, `categories`, `actor_ids`) of the items
    (`V2XDataset`) become lists of B. All other tensors are stacked, (B, …). If items have different numbers of agents,
    (B, A, …) is filled with agents whose `agent_valid` is False, images are 0 and matrices are the identity.

    Raises:
        ConfigError: there are no items, or they do not fit together: other configurations, images of different sizes.
    """
    from torch.utils.data import get_worker_info

    _check_alike(items)
    agents = max(len(item["agents"]) for item in items)
    batch: dict[str, Any] = {} if get_worker_info() is None else _WorkersBatch()
    for key in items[0]:
        values = [item[key] for item in items]
        if key in _LISTS:
            batch[key] = values
        elif key in _OF_AGENTS:
            batch[key] = _joined(key, [_with_agents(key, value, agents)[None] for value in values])
        else:
            batch[key] = _joined(key, [value[None] for value in values])
    return batch


def collate_fusion(items: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """B items as one dict with the agents of all items one after another: for V2X fusion models like those of OpenCOOD.

    Agents whose present data did not arrive are left out (for the others, `agent_valid` still says which past data are
    missing); the sample's own agent is always the first of its item. N is the number of remaining agents in the whole
    batch. The dict is that of `collate`, but tensors of agents are (N, …) instead of (B, A, …), `points` is a list of
    N, and `agents` is a list of B tuples of names. In addition:

    - `record_len` (B,) int64: how many agents each item has; they add up to N.
    - `pairwise_t_matrix` (B, L, L, 4, 4) float32, L = 5: [b, i, j] converts points of agent i's ego frame to agent j's,
      `j_from_i` = `ego_from_j`⁻¹ · `ego_from_i`, at the present, so that [b, i, 0] gives the sample's own ego frame.
      It is augmented like the points, with the link's errors; the identity on the diagonal and beyond `record_len`.

    OpenCOOD's own frames are those of the LiDARs, left-handed like CARLA's; these are ego frames, right-handed.

    Raises:
        ConfigError: there are no items, or they do not fit together: other configurations, images of different sizes.
    """
    import torch

    _check_alike(items)
    present = [item["agent_valid"][:, -1] for item in items]
    batch = collate(
        [{key: value for key, value in item.items() if key not in _OF_AGENTS} for item in items]
    )
    for key in _OF_AGENTS:
        if key in items[0]:
            batch[key] = _joined(
                key, [item[key][kept] for item, kept in zip(items, present, strict=True)]
            )
    kept_rows = [kept.nonzero()[:, 0].tolist() for kept in present]
    batch["agents"] = [
        tuple(item["agents"][row] for row in rows)
        for item, rows in zip(items, kept_rows, strict=True)
    ]
    if "points" in batch:
        batch["points"] = [
            item["points"][row] for item, rows in zip(items, kept_rows, strict=True) for row in rows
        ]
    batch["record_len"] = torch.tensor([len(rows) for rows in kept_rows])
    batch["pairwise_t_matrix"] = torch.stack(
        [
            _pairwise(item["ego_from_agent"][kept, -1])
            for item, kept in zip(items, present, strict=True)
        ]
    )
    return batch


def collate_all_egos(items: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """B moments as one dict, with an axis of the G egos of all of them one after another.

    Sensor data are as of `collate`, (B, A, …). In addition:

    - `egos`: list of G tokens. `ego_rows` (G, 2) int64: the item and the agent that each ego is.
    - `partners` (G, A) bool: which agents of that item cooperate with it.
    - the targets: stacked, (G, …), or for boxes lists of G.

    Raises:
        ConfigError: as of `collate`.
    """
    import torch

    _check_alike(items)
    batch = collate(
        [{key: value for key, value in item.items() if key not in _OF_EGOS} for item in items]
    )
    batch["egos"] = [ego for item in items for ego in item["egos"]]
    names = [
        (b, item["agents"].index(ego.rsplit("/", 2)[1]))
        for b, item in enumerate(items)
        for ego in item["egos"]
    ]
    batch["ego_rows"] = torch.tensor(names, dtype=torch.int64).reshape(-1, 2)
    agents = max(len(item["agents"]) for item in items)
    padded = [
        torch.nn.functional.pad(item["partners"], (0, agents - len(item["agents"])))
        for item in items
    ]
    batch["partners"] = torch.cat(padded)
    targets = [target for item in items for target in item["targets"]]
    for key in targets[0]:
        values = [target[key] for target in targets]
        batch[key] = values if key in _OF_BOXES else torch.stack(values)
    return batch


def _collate_by_default(items: Sequence[V2XItem], **_: object) -> dict[str, Any]:
    """`collate` or, for all egos, `collate_all_egos`, as torch calls it for a type of item."""
    return collate_all_egos(items) if "egos" in items[0] else collate(items)


with suppress(ImportError):  # torch's documented registry, which has no public place
    from torch.utils.data._utils.collate import default_collate_fn_map

    default_collate_fn_map.update(
        {V2XItem: _collate_by_default}
    )  # the site's mock of torch takes no items


class _ByValue:
    """A small tensor, as an array: copied where others become shared memory."""

    def __init__(self, array: AnyArray) -> None:
        self._array = array

    def __reduce__(self) -> tuple[Any, ...]:
        """Unpickled, the tensor itself."""
        import torch

        return torch.from_numpy, (self._array,)


def _sent(value: Any) -> Any:
    """A part of an item or a batch, as a worker hands it over."""
    import torch

    if type(value) in (list, tuple):
        return type(value)(map(_sent, value))
    if isinstance(value, dict):
        return {key: _sent(each) for key, each in value.items()}
    if (
        isinstance(value, torch.Tensor) and value.nbytes <= 1 << 16
    ):  # shared memory takes 1 ms to set up
        with suppress(
            TypeError, RuntimeError
        ):  # numpy lacks its type, or it is on a GPU, or has a gradient
            return _ByValue(value.numpy())
    return value


ForkingPickler.register(V2XItem, lambda item: (V2XItem, (_sent(item),)))
ForkingPickler.register(_WorkersBatch, lambda batch: (dict, (_sent(batch),)))


def _check_alike(items: Sequence[dict[str, Any]]) -> None:
    if not items:
        raise ConfigError("batch: expected at least one item, found none")
    for item in items[1:]:
        differing = sorted(item.keys() ^ items[0].keys())
        if differing:
            raise ConfigError(
                f"batch: only some of the items have {differing[0]!r}; batch items of one V2XConfig at a time"
            )


def _joined(key: str, parts: Sequence[Tensor]) -> Tensor:
    """Parts (n, …) one after another (N, …), a single one as it is; raises ConfigError if other axes differ."""
    import torch
    from torch.utils.data import default_collate

    sizes = sorted({tuple(part.shape[1:]) for part in parts})
    if len(sizes) > 1:
        remedy = "choose resize=" if key == "images" else "batch items of one V2XConfig at a time"
        raise ConfigError(
            f"{key}: items of shapes {sizes[0]} and {sizes[-1]} make no batch; {remedy}"
        )
    if len(parts) == 1:
        return parts[0]
    if len({len(part) for part in parts}) == 1:
        stacked: Tensor = default_collate(list(parts))  # in a worker, straight into shared memory
        return stacked.flatten(0, 1)
    return torch.cat(list(parts))


def _pairwise(ego_from_agent: Tensor) -> Tensor:
    """(L, L, 4, 4) of (n, 4, 4), padded with identities."""
    import torch

    count = len(ego_from_agent)
    exact = ego_from_agent.double()
    result = torch.eye(4).repeat(len(AGENTS), len(AGENTS), 1, 1)
    result[:count, :count] = (torch.linalg.inv(exact)[None, :] @ exact[:, None]).float()
    result[range(count), range(count)] = torch.eye(4)
    return result


def _with_agents(key: str, value: Tensor, count: int) -> Tensor:
    """A tensor (A, …), filled at the end with blank agents up to `count`."""
    import torch

    missing = count - len(value)
    if not missing:
        return value
    blank = torch.zeros((missing, *value.shape[1:]), dtype=value.dtype)
    if key in _MATRICES:
        blank[...] = torch.eye(value.shape[-1])
    return torch.cat([value, blank])


def merged_evaluator(evaluator: EvaluatorT, group: ProcessGroup | None = None) -> EvaluatorT:
    """All ranks' counts in one new evaluator, on every rank; to be called by all of them.

    Counts are small and go by token, and are summed exactly: the result has the bits of one process that counted all
    samples. A sample that ranks counted alike, as after `DistributedSampler`, counts once (`Evaluator.repeated`).

    Args:
        evaluator: this rank's, which stays as it is.
        group: whose processes take part; None for all. With NCCL, objects go over the GPUs, so each process first needs
            `torch.cuda.set_device`; a group with `gloo` needs no GPU.

    Returns:
        An evaluator with all samples; a copy of this one's where `torch.distributed` was not set up.

    Raises:
        EvaluationError: on all ranks, if one gave no evaluator, or one of other settings, or two counted the same
            sample differently.
    """
    from torch import distributed

    gathered: list[Any] = [evaluator]
    if distributed.is_available() and distributed.is_initialized():
        gathered = [None] * distributed.get_world_size(group)
        distributed.all_gather_object(gathered, evaluator, group)
    for rank, each in enumerate(gathered):
        if not isinstance(each, Evaluator):
            raise EvaluationError(
                f"evaluator: expected an Evaluator, such as MotionEvaluator(), rank {rank} has {each!r}"
            )
    merged: EvaluatorT = gathered[0].fresh()
    for each in gathered:
        merged.merge(each)
    return merged
