"""Weights in files: our own as safetensors, foreign ones of the release, BEVerse or Swin.

Names are the release's (tests/data/golden/model/released_keys_*.txt), so that the key table is the identity.
A foreign file is read by `release.checkpoints`, which runs no code of it and makes nothing large.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import msgspec
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from deepaccident_devkit.errors import MOST_TOLD, ConfigError, shortened
from deepaccident_devkit.plugins.model.images import from_official
from deepaccident_devkit.release.checkpoints import (
    FAULTS,
    NUMBER_BYTES,
    Storages,
    StoredTensor,
    read_checkpoint,
)
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import as_record, parsed_json, parsed_record
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import path_of
from deepaccident_devkit.taxonomy import SHIPPED_WEIGHTS

BEST: Final = "best.safetensors"
FINAL: Final = "final.safetensors"
# In a run's folder: the weights with the best score; of a run that was not validated, those of the last step; and the
# state from which it goes on.
LAST: Final = "last.safetensors"
# Weights that come with the devkit, by name; their notes say how they were made, and what they score where.
SHIPPED: Final = MappingProxyType(
    {name: Path(__file__).with_name(f"{name}.safetensors") for name in SHIPPED_WEIGHTS}
)
# Beginning of the names of the optimizer's tensors in that state.
OPTIMIZER: Final = "optimizer."
_META: Final = "deepaccident"
# Ends of names whose values follow from the configuration, or do not matter.
_MADE: Final = ("relative_position_index", "transformer.frustum", "num_batches_tracked")
_TOLD: Final = 3
# Bytes of the header of a safetensors file; `released` has 0.1 MB.
_HEADER: Final = 4 << 20
_FACTOR: Final = 4
# Tensors may have so many times the bytes of their foreign file, and so many more: several may share theirs.
_ROOM: Final = 1 << 20
# What a damaged or hostile file of weights can raise.
_FAULTS: Final = (SafetensorError, *FAULTS)


class _Header(msgspec.Struct):
    """What else than tensors is in the header of a safetensors file."""

    metadata: dict[str, str] = msgspec.field(name="__metadata__", default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weights(ShortRepr):
    """Tensors by name, and what is known of them.

    Attributes:
        tensors: by the model's names.
        meta: of our own files: the preset, and how they were made; empty for foreign ones.
        path: of the file.
    """

    tensors: Mapping[str, Tensor]
    meta: Mapping[str, Any]
    path: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Loaded(ShortRepr):
    """What `load_weights` did.

    Attributes:
        loaded: names of the model's tensors that the file had.
        kept: names that it did not have: they stay as they were.
        unused: names that only the file has.
    """

    loaded: tuple[str, ...]
    kept: tuple[str, ...]
    unused: tuple[str, ...]

    def to_text(self) -> str:
        """One line."""
        whole = len(self.loaded) + len(self.kept)
        kept = f"; as they were: {_some(self.kept)}" if self.kept else ""
        unused = f"; of the file not used: {_some(self.unused)}" if self.unused else ""
        return f"{len(self.loaded)} of {whole} tensors loaded{kept}{unused}"


def read_weights(path: str | os.PathLike[str]) -> Weights:
    """The weights in a file: safetensors, or a foreign checkpoint (`.pth`, `.pt`); of a run's folder, the best.

    A name of `SHIPPED` that is no file or folder stands for those weights.

    Raises:
        ConfigError: the file is not there, cannot be read, or holds no state dict.
    """
    path = path_of(path)
    if not path.exists():
        path = SHIPPED.get(str(path), path)
    if path.is_dir():
        path = next(
            (path / name for name in (BEST, FINAL, LAST) if (path / name).is_file()), path / BEST
        )
    try:
        content = read_bytes(path, "weights")
    except OSError as error:
        raise ConfigError(
            f"{path}: weights cannot be read ({error.strerror or error}); give a file of weights"
        ) from error
    if content[8:9] != b"{" and content[:2] in (
        b"PK",
        b"\x80\x02",
    ):  # what torch.save writes, or wrote
        return Weights(tensors=_foreign(content, path), meta={}, path=path)
    try:
        length = int.from_bytes(content[:8], "little")
        if length > _HEADER:
            raise ValueError(f"its header would have {length:,} bytes")
        header = parsed_record(content[8 : 8 + length], _Header)
        meta = as_record(parsed_json(header.metadata.get(_META, "{}").encode()), dict[str, Any])
        tensors: dict[str, Tensor] = load(content)
        for name, each in tensors.items():
            if str(each.dtype).removeprefix("torch.") not in NUMBER_BYTES:
                raise ValueError(f"{shortened(name)!r} has numbers of {each.dtype}")
    except _FAULTS as error:
        raise ConfigError(
            f"{path}: is no file of weights ({reason_of(error)}); give a safetensors file, or a .pth"
        ) from error
    return Weights(tensors=tensors, meta=meta, path=path)


def reason_of(error: Exception) -> str:
    """What an error says, for a message: the first line, and not all of a long one."""
    return shortened(fault_text(error).splitlines()[0], MOST_TOLD)


def write_weights(
    path: Path, tensors: Mapping[str, Tensor], meta: Mapping[str, Any], *, half: bool = False
) -> None:
    """Write weights as safetensors, completely or not at all; the same ones give the same bytes.

    Args:
        path: of the file.
        tensors: by name.
        meta: what to note with them, as JSON holds it.
        half: whether floats are rounded to float16.
    """
    stored = {
        name: (each.half() if half and each.is_floating_point() else each)
        for name, each in tensors.items()
    }
    ready = {name: each.detach().cpu().contiguous() for name, each in stored.items()}
    write_bytes(path, save(ready, metadata={_META: json.dumps(dict(meta), sort_keys=True)}))


def load_weights(model: nn.Module, weights: Weights, *, whole: bool = False) -> Loaded:
    """Put weights into a model.

    Args:
        model: whose names are compared.
        weights: from `read_weights`.
        whole: whether they must have every tensor of the model that training changes.

    Returns:
        Which tensors were loaded, and which not.

    Raises:
        ConfigError: the file has none of the model's tensors, tensors of other shapes, or lacks some though `whole`.
    """
    own = model.state_dict()
    given = {name: each for name, each in weights.tensors.items() if not _is_apart(name)}
    wanted = [name for name in own if not _is_apart(name)]
    loaded = [name for name in wanted if name in given]
    missing = [name for name in wanted if name not in given]
    other = [name for name in loaded if own[name].shape != given[name].shape]
    unused = sorted(name for name in given if name not in own)
    if other or not loaded or (whole and missing):
        raise ConfigError(f"{weights.path}: {_difference(weights, own, other, missing, unused)}")
    model.load_state_dict({name: given[name].to(own[name].dtype) for name in loaded}, strict=False)
    return Loaded(loaded=tuple(loaded), kept=tuple(missing), unused=tuple(unused))


def _is_apart(name: str) -> bool:
    """Whether a tensor is no weight: it follows from the configuration, or is the optimizer's."""
    return name.endswith(_MADE) or name.startswith(OPTIMIZER)


def _difference(
    weights: Weights,
    own: Mapping[str, Tensor],
    other: Sequence[str],
    missing: Sequence[str],
    unused: Sequence[str],
) -> str:
    """What keeps weights from fitting a model, with the remedy."""
    told = []
    if other:
        found = shortened(str(tuple(weights.tensors[other[0]].shape)))
        shapes = f"{other[0]} is {found}, not {tuple(own[other[0]].shape)}"
        told.append(f"{len(other)} tensors have another shape ({shapes})")
    if missing:
        told.append(f"{len(missing)} of the model are missing ({_some(missing)})")
    if unused:
        told.append(f"{len(unused)} are not the model's ({_some(unused)})")
    preset = weights.meta.get("preset")
    whose = f"weights of the preset {shortened(repr(preset))}" if preset else "weights"
    return f"{whose} do not fit this model: {', '.join(told)}; give the preset and the options that they were trained with"


def _some(names: Sequence[str]) -> str:
    return ", ".join(map(shortened, names[:_TOLD])) + (
        f", … ({len(names)})" if len(names) > _TOLD else ""
    )


def _foreign(content: bytes, path: Path) -> dict[str, Tensor]:
    """A foreign checkpoint's tensors under our names."""
    try:
        found, storages = read_checkpoint(content)
        for name in ("state_dict", "model"):  # mmcv's, Swin's
            if isinstance(found, dict) and isinstance(found.get(name), dict):
                found = found[name]
        pairs = found.items() if isinstance(found, dict) else ()
        stored = {
            name: each
            for name, each in pairs
            if isinstance(name, str) and isinstance(each, StoredTensor)
        }
        if sum(each.size for each in stored.values()) > _FACTOR * len(content) + _ROOM:
            raise ValueError("its tensors are far larger than the file")
        named = {
            name.removeprefix("module."): each for name, each in _made(stored, storages).items()
        }
        if "patch_embed.proj.weight" in named:
            named = from_official(named)
    except _FAULTS as error:
        raise ConfigError(
            f"{path}: is no plain checkpoint ({reason_of(error)}); give one that holds tensors alone"
        ) from error
    if not named:
        raise ConfigError(f"{path}: holds no tensors by name; give a state dict")
    if not any("." in name and name.split(".")[0] in _PARTS for name in named):
        named = {
            f"img_backbone.{name}": each for name, each in named.items()
        }  # an image encoder alone
    return named


def _made(stored: Mapping[str, StoredTensor], storages: Storages) -> dict[str, Tensor]:
    """Tensors, of which those of one storage share its memory; raises one of `_FAULTS`."""
    contents = {
        name: bytearray(storages(name)) for name in {each.storage for each in stored.values()}
    }
    tensors = {}
    for name, each in stored.items():
        content, dtype = contents[each.storage], getattr(torch, each.dtype)
        whole = torch.frombuffer(content, dtype=dtype) if content else torch.empty(0, dtype=dtype)
        # which refuses, before anything is made, what reaches beyond the storage
        tensors[name] = whole.as_strided(each.shape, each.strides, each.offset)
    return tensors


_PARTS: Final = ("img_backbone", "img_neck", "transformer", "temporal_model", "pts_bbox_head")
