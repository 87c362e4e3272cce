"""Weights in files: our own as safetensors, foreign ones of the release, BEVerse or Swin.

Names are the release's (tests/data/golden/model/released_keys_*.txt), so the key table is the
identity. A foreign file is read by `release.checkpoints`, which runs no code from it and allocates
nothing large.
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

# Files of a run's folder: the weights with the best score; for a run without validation the weights
# of the last step; and the state from which the run continues.
BEST_FILE: Final = "best.safetensors"
FINAL_FILE: Final = "final.safetensors"
STATE_FILE: Final = "last.safetensors"
# Weights that are part of the devkit, by name; their notes describe their training and their
# scores.
SHIPPED_FILES: Final = MappingProxyType(
    {name: Path(__file__).with_name(f"{name}.safetensors") for name in SHIPPED_WEIGHTS}
)
# Prefix of the names of the optimizer's tensors in the state.
OPTIMIZER_PREFIX: Final = "optimizer."
_META_KEY: Final = "deepaccident"
# Suffixes of names with values that follow from the configuration, or do not matter.
_DERIVED_SUFFIXES: Final = (
    "relative_position_index",
    "transformer.frustum",
    "num_batches_tracked",
)
# Number of names that a message lists.
_MAX_LISTED_NAMES: Final = 3
# Size of the header of a safetensors file; that of `released` has 0.1 MB.
_MAX_HEADER_BYTES: Final = 4 << 20
# Tensors of a foreign file may be larger than the file by this factor and this constant, because
# several may share their storage.
_MAX_EXPANSION: Final = 4
_MAX_EXTRA_BYTES: Final = 1 << 20
# Exceptions that a damaged or hostile file of weights can raise.
_FAULTS: Final = (SafetensorError, *FAULTS)
_MODEL_PARTS: Final = ("img_backbone", "img_neck", "transformer", "temporal_model", "pts_bbox_head")


class _Header(msgspec.Struct):
    """The header of a safetensors file, except the tensors."""

    metadata: dict[str, str] = msgspec.field(name="__metadata__", default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weights(ShortRepr):
    """Tensors by name, and notes on them.

    Attributes:
        tensors: Tensors by the model's names.
        meta: Notes of our own files: the preset, and the training; empty for foreign ones.
        path: Path of the file.
    """

    tensors: Mapping[str, Tensor]
    meta: Mapping[str, Any]
    path: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Loaded(ShortRepr):
    """The result of `load_weights`.

    Attributes:
        loaded: Names of the model's tensors that the file had.
        unchanged: Names of the model's tensors that the file did not have.
        unused: Names that only the file has.
    """

    loaded: tuple[str, ...]
    unchanged: tuple[str, ...]
    unused: tuple[str, ...]

    def to_text(self) -> str:
        """Return one line of text."""
        total = len(self.loaded) + len(self.unchanged)
        unchanged = f"; as they were: {_names_text(self.unchanged)}" if self.unchanged else ""
        unused = f"; of the file not used: {_names_text(self.unused)}" if self.unused else ""
        return f"{len(self.loaded)} of {total} tensors loaded{unchanged}{unused}"


def read_weights(path: str | os.PathLike[str]) -> Weights:
    """Read the weights in a file: safetensors, or a foreign checkpoint (`.pth`, `.pt`).

    For a run's folder these are the best weights. A name of `SHIPPED_FILES` that is no file or
    folder stands for the shipped weights.

    Raises:
        ConfigError: The file does not exist, cannot be read, or holds no state dict.
    """
    path = _weights_path(path_of(path))
    try:
        content = read_bytes(path, "weights")
    except OSError as error:
        raise ConfigError(
            f"{path}: weights cannot be read ({error.strerror or error}); give a file of weights"
        ) from error
    # torch.save writes zip files, and wrote pickles before.
    if content[8:9] != b"{" and content[:2] in (b"PK", b"\x80\x02"):
        return Weights(tensors=_foreign_tensors(content, path), meta={}, path=path)
    try:
        length = int.from_bytes(content[:8], "little")
        if length > _MAX_HEADER_BYTES:
            raise ValueError(f"its header would have {length:,} bytes")
        header = parsed_record(content[8 : 8 + length], _Header)
        meta_text = header.metadata.get(_META_KEY, "{}")
        meta = as_record(parsed_json(meta_text.encode()), dict[str, Any])
        tensors: dict[str, Tensor] = load(content)
        for name, tensor in tensors.items():
            if str(tensor.dtype).removeprefix("torch.") not in NUMBER_BYTES:
                raise ValueError(f"{shortened(name)!r} has numbers of {tensor.dtype}")
    except _FAULTS as error:
        raise ConfigError(
            f"{path}: is no file of weights ({reason_of(error)}); give a safetensors file, or a "
            ".pth"
        ) from error
    return Weights(tensors=tensors, meta=meta, path=path)


def _weights_path(path: Path) -> Path:
    """Return the path of the file of shipped weights or of a run's folder."""
    if not path.exists():
        path = SHIPPED_FILES.get(str(path), path)
    if not path.is_dir():
        return path
    for name in (BEST_FILE, FINAL_FILE, STATE_FILE):
        if (path / name).is_file():
            return path / name
    return path / BEST_FILE


def reason_of(error: Exception) -> str:
    """Return the reason in an error for a message: the first line, shortened."""
    return shortened(fault_text(error).splitlines()[0], MOST_TOLD)


def write_weights(
    path: Path, tensors: Mapping[str, Tensor], meta: Mapping[str, Any], *, half: bool = False
) -> None:
    """Write weights as safetensors, atomically; equal weights give equal bytes.

    Args:
        path: Path of the file.
        tensors: Tensors by name.
        meta: Notes that are stored with them, as JSON holds them.
        half: Whether floats are rounded to float16.
    """
    contiguous = {}
    for name, tensor in tensors.items():
        stored = tensor.half() if half and tensor.is_floating_point() else tensor
        contiguous[name] = stored.detach().cpu().contiguous()
    meta_text = json.dumps(dict(meta), sort_keys=True)
    write_bytes(path, save(contiguous, metadata={_META_KEY: meta_text}))


def load_weights(model: nn.Module, weights: Weights, *, whole: bool = False) -> Loaded:
    """Load weights into a model.

    Args:
        model: The model; its names are compared.
        weights: Weights from `read_weights`.
        whole: Whether they must have every tensor of the model that training changes.

    Returns:
        The names of the tensors that were loaded, and of the others.

    Raises:
        ConfigError: The file has none of the model's tensors, tensors of other shapes, or lacks
            some although `whole`.
    """
    model_state = model.state_dict()
    file_state = {
        name: tensor for name, tensor in weights.tensors.items() if not _is_no_weight(name)
    }
    names = [name for name in model_state if not _is_no_weight(name)]
    loaded = [name for name in names if name in file_state]
    missing = [name for name in names if name not in file_state]
    misshapen = [name for name in loaded if model_state[name].shape != file_state[name].shape]
    unused = sorted(name for name in file_state if name not in model_state)
    if misshapen or not loaded or (whole and missing):
        difference = _difference_text(weights, model_state, misshapen, missing, unused)
        raise ConfigError(f"{weights.path}: {difference}")
    loaded_state = {name: file_state[name].to(model_state[name].dtype) for name in loaded}
    model.load_state_dict(loaded_state, strict=False)
    return Loaded(loaded=tuple(loaded), unchanged=tuple(missing), unused=tuple(unused))


def _is_no_weight(name: str) -> bool:
    """Return whether a tensor follows from the configuration, or belongs to the optimizer."""
    return name.endswith(_DERIVED_SUFFIXES) or name.startswith(OPTIMIZER_PREFIX)


def _difference_text(
    weights: Weights,
    model_state: Mapping[str, Tensor],
    misshapen: Sequence[str],
    missing: Sequence[str],
    unused: Sequence[str],
) -> str:
    """Return why weights do not fit a model, with the remedy."""
    reasons = []
    if misshapen:
        name = misshapen[0]
        shape = shortened(str(tuple(weights.tensors[name].shape)))
        shapes = f"{name} is {shape}, not {tuple(model_state[name].shape)}"
        reasons.append(f"{len(misshapen)} tensors have another shape ({shapes})")
    if missing:
        reasons.append(f"{len(missing)} of the model are missing ({_names_text(missing)})")
    if unused:
        reasons.append(f"{len(unused)} are not the model's ({_names_text(unused)})")
    preset = weights.meta.get("preset")
    subject = f"weights of the preset {shortened(repr(preset))}" if preset else "weights"
    return (
        f"{subject} do not fit this model: {', '.join(reasons)}; give the preset and the options "
        "that they were trained with"
    )


def _names_text(names: Sequence[str]) -> str:
    """Return a few of the names, and their number if there are more."""
    text = ", ".join(map(shortened, names[:_MAX_LISTED_NAMES]))
    return f"{text}, … ({len(names)})" if len(names) > _MAX_LISTED_NAMES else text


def _foreign_tensors(content: bytes, path: Path) -> dict[str, Tensor]:
    """Return a foreign checkpoint's tensors under our names; raises ConfigError."""
    try:
        checkpoint, storages = read_checkpoint(content)
        for name in ("state_dict", "model"):  # mmcv's, Swin's
            if isinstance(checkpoint, dict) and isinstance(checkpoint.get(name), dict):
                checkpoint = checkpoint[name]
        stored = {}
        for name, value in checkpoint.items() if isinstance(checkpoint, dict) else ():
            if isinstance(name, str) and isinstance(value, StoredTensor):
                stored[name] = value
        size = sum(tensor.size for tensor in stored.values())
        if size > _MAX_EXPANSION * len(content) + _MAX_EXTRA_BYTES:
            raise ValueError("its tensors are far larger than the file")
        tensors = {
            name.removeprefix("module."): tensor
            for name, tensor in _opened(stored, storages).items()
        }
        if "patch_embed.proj.weight" in tensors:
            tensors = from_official(tensors)
    except _FAULTS as error:
        raise ConfigError(
            f"{path}: is no plain checkpoint ({reason_of(error)}); give one that holds tensors "
            "alone"
        ) from error
    if not tensors:
        raise ConfigError(f"{path}: holds no tensors by name; give a state dict")
    if any("." in name and name.split(".")[0] in _MODEL_PARTS for name in tensors):
        return tensors
    # The file only has an image encoder.
    return {f"img_backbone.{name}": tensor for name, tensor in tensors.items()}


def _opened(stored: Mapping[str, StoredTensor], storages: Storages) -> dict[str, Tensor]:
    """Return the stored tensors; tensors of one storage share its memory.

    Raises one of `_FAULTS`.
    """
    storage_names = {tensor.storage for tensor in stored.values()}
    contents = {name: bytearray(storages(name)) for name in storage_names}
    tensors = {}
    for name, tensor in stored.items():
        content, dtype = contents[tensor.storage], getattr(torch, tensor.dtype)
        storage = torch.frombuffer(content, dtype=dtype) if content else torch.empty(0, dtype=dtype)
        # A tensor that reaches beyond the storage is refused before memory is allocated.
        tensors[name] = storage.as_strided(tensor.shape, tensor.strides, tensor.offset)
    return tensors
