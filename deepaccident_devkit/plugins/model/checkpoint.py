"""Weight files: the devkit's as safetensors, and foreign ones of the release, BEVerse or Swin.

Names are the release's (tests/data/golden/model/released_keys_*.txt), so the key table is the
identity. A foreign file is read by `release.checkpoints`, which runs no code from it and allocates
nothing large.
"""

import json
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

from deepaccident_devkit.errors import MAX_REASON_LENGTH, ConfigError, shortened
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
from deepaccident_devkit.support.reading import read_bytes, reason_text
from deepaccident_devkit.support.text import PathType, counted, path_of
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
_META_KEY = "deepaccident"
# Suffixes of names with values that follow from the configuration, or do not matter.
_DERIVED_SUFFIXES = (
    "relative_position_index",
    "transformer.frustum",
    "num_batches_tracked",
)
# Number of names that a message lists.
_MAX_LISTED_NAMES = 3
# Maximum size of a safetensors file's header; the header of `released` has 0.1 MB.
_MAX_HEADER_BYTES = 4 << 20
# Tensors of a foreign file may be larger than the file by this factor and this constant, because
# several may share their storage.
_MAX_EXPANSION = 4
_MAX_EXTRA_BYTES = 1 << 20
# Exceptions that a damaged or hostile file of weights can raise.
_FAULTS = (SafetensorError, *FAULTS)
# Prefixes of names by which a checkpoint of the complete model is recognised.
_MODEL_PREFIXES = (
    "img_backbone.",
    "img_neck.",
    "transformer.",
    "temporal_model.",
    "pts_bbox_head.",
)


class _Header(msgspec.Struct):
    """The header of a safetensors file, except the tensors."""

    metadata: dict[str, str] = msgspec.field(name="__metadata__", default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weights(ShortRepr):
    """Tensors by name, and notes on them.

    Attributes:
        tensors: Tensors by the model's names.
        meta: Notes in the devkit's files: the preset and the training; empty for foreign files.
        path: Path of the file.
    """

    tensors: Mapping[str, Tensor]
    meta: Mapping[str, Any]
    path: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Loaded(ShortRepr):
    """The result of `load_weights`.

    Attributes:
        loaded: Names of the model's tensors that the file contained.
        unchanged: Names of the model's tensors that the file did not contain.
        unused: Names of the file's tensors that the model does not have.
    """

    loaded: tuple[str, ...]
    unchanged: tuple[str, ...]
    unused: tuple[str, ...]

    def to_text(self) -> str:
        """Return one line of text."""
        total = len(self.loaded) + len(self.unchanged)
        text = f"{len(self.loaded)} of {counted(total, 'tensor')} loaded"
        if self.unchanged:
            text += f"; not in the file: {_list_names(self.unchanged)}"
        if self.unused:
            text += f"; not used from the file: {_list_names(self.unused)}"
        return text


def read_weights(path: PathType) -> Weights:
    """Read the weights in a file: safetensors, or a foreign checkpoint (`.pth`, `.pt`).

    For a run's folder, the best weights are read. A name from `SHIPPED_FILES` loads the shipped
    weights, unless a file or folder of that name exists.

    Raises:
        ConfigError: The file does not exist, cannot be read, or holds no state dict.
    """
    path = _find_weights(path_of(path))
    try:
        content = read_bytes(path, "weights")
    except OSError as error:
        raise ConfigError(
            f"{path}: weights cannot be read ({error.strerror or error}); give a file of weights"
        ) from error
    # torch.save writes zip files; older versions wrote pickles.
    if content[8:9] != b"{" and content[:2] in (b"PK", b"\x80\x02"):
        return Weights(tensors=_read_foreign_tensors(content, path), meta={}, path=path)
    try:
        header_bytes = int.from_bytes(content[:8], "little")
        if header_bytes > _MAX_HEADER_BYTES:
            raise ValueError(f"its header claims {header_bytes:,} bytes")
        header = parsed_record(content[8 : 8 + header_bytes], _Header)
        meta_text = header.metadata.get(_META_KEY, "{}")
        meta = as_record(parsed_json(meta_text.encode()), dict[str, Any])
        tensors = load(content)
        for name, tensor in tensors.items():
            dtype_name = str(tensor.dtype).removeprefix("torch.")
            if dtype_name not in NUMBER_BYTES:
                raise ValueError(f"{shortened(name)!r} has numbers of {tensor.dtype}")
    except _FAULTS as error:
        raise ConfigError(
            f"{path}: is not a file of weights ({short_reason(error)}); give a safetensors file, "
            "or a .pth"
        ) from error
    return Weights(tensors=tensors, meta=meta, path=path)


def _find_weights(path: Path) -> Path:
    """Return the path of the weights for a file, a run's folder or a shipped name."""
    if not path.exists():
        path = SHIPPED_FILES.get(str(path), path)
    if not path.is_dir():
        return path
    for name in (BEST_FILE, FINAL_FILE, STATE_FILE):
        if (path / name).is_file():
            return path / name
    return path / BEST_FILE


def short_reason(error: Exception) -> str:
    """Return the first line of an error's message, shortened."""
    first_line = reason_text(error).splitlines()[0]
    return shortened(first_line, MAX_REASON_LENGTH)


def write_weights(
    path: Path, tensors: Mapping[str, Tensor], meta: Mapping[str, Any], *, half: bool = False
) -> None:
    """Write weights as safetensors, atomically; equal weights give equal bytes.

    Args:
        path: Path of the file.
        tensors: Tensors by name.
        meta: Notes that are stored with the tensors, in JSON types.
        half: Whether floats are rounded to float16.
    """
    stored_tensors = {}
    for name, tensor in tensors.items():
        stored = tensor.detach().cpu().contiguous()
        if half and stored.is_floating_point():
            stored = stored.half()
        stored_tensors[name] = stored
    meta_text = json.dumps(dict(meta), sort_keys=True)
    write_bytes(path, save(stored_tensors, {_META_KEY: meta_text}))


def load_weights(model: nn.Module, weights: Weights, *, whole: bool = False) -> Loaded:
    """Load weights into a model.

    Args:
        model: The model; weights are found by the names of its tensors.
        weights: Weights from `read_weights`.
        whole: Whether the weights must contain every tensor of the model that training changes.

    Returns:
        The names of the loaded, unchanged and unused tensors.

    Raises:
        ConfigError: The file contains none of the model's tensors or a tensor of another shape, or
            `whole` is set and a tensor is missing.
    """
    model_state = model.state_dict()
    file_state = weights.tensors
    loaded_state = {}
    missing_names = []
    misshapen = []
    for name, model_tensor in model_state.items():
        if not _is_weight(name):
            continue
        if name not in file_state:
            missing_names.append(name)
            continue
        file_tensor = file_state[name]
        if file_tensor.shape == model_tensor.shape:
            loaded_state[name] = file_tensor.to(model_tensor.dtype)
        else:
            misshapen.append(name)
    unused = [name for name in file_state if _is_weight(name) and name not in model_state]
    unused.sort()
    if misshapen or not loaded_state or (whole and missing_names):
        difference = _describe_difference(weights, model_state, misshapen, missing_names, unused)
        raise ConfigError(f"{weights.path}: {difference}")
    model.load_state_dict(loaded_state, strict=False)
    return Loaded(loaded=tuple(loaded_state), unchanged=tuple(missing_names), unused=tuple(unused))


def _is_weight(name: str) -> bool:
    """Return whether a tensor is neither derived from the configuration nor the optimizer's."""
    if name.startswith(OPTIMIZER_PREFIX):
        return False
    return not name.endswith(_DERIVED_SUFFIXES)


def _describe_difference(
    weights: Weights,
    model_state: Mapping[str, Tensor],
    misshapen: Sequence[str],
    missing: Sequence[str],
    unused: Sequence[str],
) -> str:
    """Explain why weights do not fit a model, with the remedy."""
    reasons = []
    if misshapen:
        name = misshapen[0]
        shape = shortened(str(tuple(weights.tensors[name].shape)))
        shapes = f"{name} is {shape}, not {tuple(model_state[name].shape)}"
        reasons.append(f"{counted(len(misshapen), 'tensor')} with another shape ({shapes})")
    if missing:
        reasons.append(f"{counted(len(missing), 'tensor')} missing ({_list_names(missing)})")
    if unused:
        reasons.append(f"{counted(len(unused), 'tensor')} unknown ({_list_names(unused)})")
    subject = "weights"
    preset = weights.meta.get("preset")
    if preset:
        subject = f"weights of the preset {shortened(repr(preset))}"
    return (
        f"{subject} do not fit this model: {', '.join(reasons)}; give the preset and the options "
        "that they were trained with"
    )


def _list_names(names: Sequence[str]) -> str:
    """List the first names as text, followed by the total number if there are more."""
    listed_names = names[:_MAX_LISTED_NAMES]
    text = ", ".join(map(shortened, listed_names))
    if len(names) > _MAX_LISTED_NAMES:
        text += f", … ({len(names)})"
    return text


def _read_foreign_tensors(content: bytes, path: Path) -> dict[str, Tensor]:
    """Read a foreign checkpoint's tensors under our names; raise ConfigError if it is unknown."""
    try:
        checkpoint, storages = read_checkpoint(content)
        stored = _find_tensors(checkpoint)
        total_bytes = sum(tensor.size for tensor in stored.values())
        if total_bytes > _MAX_EXPANSION * len(content) + _MAX_EXTRA_BYTES:
            raise ValueError("its tensors are far larger than the file")
        tensors = {}
        for name, tensor in _open_tensors(stored, storages).items():
            tensors[name.removeprefix("module.")] = tensor
        if "patch_embed.proj.weight" in tensors:
            tensors = from_official(tensors)
    except _FAULTS as error:
        raise ConfigError(
            f"{path}: is not a plain checkpoint ({short_reason(error)}); give a checkpoint that "
            "contains only tensors"
        ) from error
    if not tensors:
        raise ConfigError(f"{path}: contains no named tensors; give a state dict")
    if any(name.startswith(_MODEL_PREFIXES) for name in tensors):
        return tensors
    # The file contains only an image encoder.
    return {f"img_backbone.{name}": tensor for name, tensor in tensors.items()}


def _find_tensors(checkpoint: Any) -> dict[str, StoredTensor]:
    """Return the tensors of a checkpoint's state dict by name."""
    for key in ("state_dict", "model"):  # mmcv's, Swin's
        if isinstance(checkpoint, dict) and isinstance(checkpoint.get(key), dict):
            checkpoint = checkpoint[key]
    stored: dict[str, StoredTensor] = {}
    if not isinstance(checkpoint, dict):
        return stored
    for name, value in checkpoint.items():
        if isinstance(name, str) and isinstance(value, StoredTensor):
            stored[name] = value
    return stored


def _open_tensors(stored: Mapping[str, StoredTensor], storages: Storages) -> dict[str, Tensor]:
    """Return the stored tensors; tensors of one storage share its memory.

    A damaged tensor raises one of `_FAULTS`.
    """
    storage_names = {tensor.storage for tensor in stored.values()}
    contents = {name: bytearray(storages(name)) for name in storage_names}
    tensors = {}
    for name, tensor in stored.items():
        content = contents[tensor.storage]
        dtype = getattr(torch, tensor.dtype)
        if content:
            storage = torch.frombuffer(content, dtype=dtype)
        else:
            storage = torch.empty(0, dtype=dtype)
        # Refuse a tensor that extends beyond its storage before memory is allocated.
        tensors[name] = storage.as_strided(tensor.shape, tensor.strides, tensor.offset)
    return tensors
