"""Weight files: our own bit for bit, foreign ones by their names, and other files."""

import pickle
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from support.expected_errors import assert_raises
from torch_extra.compared import are_identical
from torch_extra.model.small_model import small_config, small_released_config

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.checkpoint import (
    BEST_FILE,
    FINAL_FILE,
    load_weights,
    read_weights,
    write_weights,
)
from deepaccident_devkit.plugins.model.images import SwinConfig
from deepaccident_devkit.plugins.model.network import V2XFormer

META = {"preset": "tiny", "fusion": None, "horizon": 2.0, "note": 'a "quoted" ä'}


def make_model(seed: int) -> V2XFormer:
    torch.manual_seed(seed)
    return V2XFormer(small_config())


def select_trained(model: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Select the tensors that training changes, which a file must have."""
    return {
        name: tensor
        for name, tensor in model.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }


def test_weights_come_back_bit_for_bit(tmp_path: Path) -> None:
    first, second = make_model(0), make_model(1)
    path = tmp_path / "weights.safetensors"

    write_weights(path, first.state_dict(), META)
    content = path.read_bytes()
    weights = read_weights(path)
    assert weights.meta == META
    assert are_identical(dict(weights.tensors), dict(first.state_dict()))

    load_weights(second, weights, whole=True)
    assert are_identical(select_trained(first), select_trained(second))

    write_weights(path, first.state_dict(), META)
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == content


def test_weights_of_another_preset_name_the_keys(tmp_path: Path) -> None:
    path = tmp_path / "released.safetensors"
    write_weights(
        path, V2XFormer(small_released_config()).state_dict(), META | {"preset": "released"}
    )
    message = (
        rf"\A{re.escape(str(path))}: weights of the preset 'released' do not fit this model: "
        r"[^\n]*img_backbone\.fine\.0\.0\.weight[^\n]*img_backbone\.norm2\.bias[^\n]*"
        r"; give the preset and the options that they were trained with\Z"
    )
    assert_raises((lambda: load_weights(make_model(0), read_weights(path)), ConfigError, message))


def test_tensors_of_other_shapes_are_named_and_nothing_is_loaded(tmp_path: Path) -> None:
    path = tmp_path / "tiny.safetensors"
    tensors = dict(make_model(0).state_dict())
    name = next(key for key in tensors if key.endswith("weight"))
    tensors[name] = tensors[name][:1]
    write_weights(path, tensors, META)

    model = make_model(1)
    assert_raises(
        (
            lambda: load_weights(model, read_weights(path)),
            ConfigError,
            rf"1 tensor with another shape \({re.escape(name)} is \(1, .*, not \(",
        )
    )
    assert are_identical(model.state_dict(), make_model(1).state_dict())


def test_missing_weights_begin_at_random_unless_all_are_needed(tmp_path: Path) -> None:
    state = make_model(0).state_dict()
    image_tensors = {name: state[name] for name in state if name.startswith("img_")}
    foreign_tensors = {"other.weight": torch.zeros(2)}
    write_weights(tmp_path / "part.safetensors", image_tensors | foreign_tensors, {})
    write_weights(tmp_path / "other.safetensors", foreign_tensors, {})
    model, untouched_model = make_model(1), make_model(1)

    weights = read_weights(tmp_path / "part.safetensors")
    report = load_weights(model, weights)
    assert report.unused == ("other.weight",)
    assert not any(name.startswith("img_") for name in report.unchanged)
    for name in report.unchanged:
        assert are_identical(model.state_dict()[name], untouched_model.state_dict()[name])

    foreign_weights = read_weights(tmp_path / "other.safetensors")
    assert_raises(
        (
            lambda: load_weights(model, weights, whole=True),
            ConfigError,
            r"weights do not fit this model: \d+ tensors missing \(",
        ),
        (
            lambda: load_weights(model, foreign_weights),
            ConfigError,
            r"1 tensor unknown \(other\.weight\)",
        ),
    )


@pytest.mark.parametrize("is_zipped", [True, False])
@pytest.mark.parametrize("prefix", ["", "module."])
@pytest.mark.parametrize("has_notes", [True, False])
def test_foreign_checkpoints_have_our_names(
    tmp_path: Path, *, is_zipped: bool, prefix: str, has_notes: bool
) -> None:
    """mmcv adds notes and a prefix, and older torch wrote files that are not zipped."""
    path = tmp_path / "epoch_20.pth"
    source, model = make_model(0), make_model(1)
    content: Any = {f"{prefix}{name}": tensor for name, tensor in source.state_dict().items()}
    if has_notes:
        content = {"meta": {"epoch": 20, "config": "text"}, "state_dict": content}
    torch.save(content, path, _use_new_zipfile_serialization=is_zipped)

    weights = read_weights(path)
    load_weights(model, weights, whole=True)

    assert weights.meta == {}
    assert are_identical(select_trained(model), select_trained(source))


def test_the_released_checkpoints_unused_layers_are_reported(tmp_path: Path) -> None:
    """The checkpoint has V2X layers that nothing uses, and BEVerse's map task."""
    first, second = V2XFormer(small_released_config()), V2XFormer(small_released_config())
    unused_layers = {
        "v2x_fusion.model.0.conv.weight": torch.zeros(2),
        "v2x_fusion.compression.0.weight": torch.zeros(2),
        "pts_bbox_head.taskfeat_encoders.map.layer.weight": torch.zeros(2),
        "pts_bbox_head.task_decoders.map.layer.weight": torch.zeros(2),
        "img_backbone.stages.0.blocks.0.attn.w_msa.relative_position_index": torch.zeros(16, 16),
    }
    path = tmp_path / "beverse.pth"
    torch.save({"state_dict": dict(first.state_dict()) | unused_layers}, path)

    report = load_weights(second, read_weights(path), whole=True)

    assert are_identical(select_trained(first), select_trained(second))
    assert sorted(report.unused) == sorted(list(unused_layers)[:4])


class MaliciousObject:
    """An object that creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("writer", ["pickle", "torch", "old torch"])
def test_code_in_a_file_is_refused_and_not_run(tmp_path: Path, writer: str) -> None:
    path, created_file = tmp_path / "weights.pth", tmp_path / "created"
    tensors = {"img_neck.weight": torch.zeros(1)}
    content = {"state_dict": tensors, "meta": MaliciousObject(created_file)}
    if writer == "pickle":
        path.write_bytes(pickle.dumps(content, protocol=2))
    else:
        torch.save(content, path, _use_new_zipfile_serialization=writer == "torch")

    assert_unreadable(path, "is not a plain checkpoint")
    assert not created_file.exists()


def assert_unreadable(path: Path, message: str) -> None:
    """Check that the file is refused in one line that ends with a remedy."""
    assert_raises(
        (
            lambda: read_weights(path),
            ConfigError,
            rf"\A{re.escape(f'{path}: {message}')}[^\n]*; give [^\n]*\Z",
        )
    )


def with_notes(text: str) -> Callable[[Path], None]:
    tensors = {"img_neck.weight": torch.zeros(1)}
    return lambda path: save_file(tensors, path, metadata={"deepaccident": text})


def cut_off(write: Callable[[Path], object], share: float) -> Callable[[Path], None]:
    """Return a writer of the first share of a file."""

    def write_part(path: Path) -> None:
        write(path)
        size = int(path.stat().st_size * share)
        path.write_bytes(path.read_bytes()[:size])

    return write_part


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda _: None, "weights cannot be read (No such file or directory)"),
        *(
            (lambda path, content=content: path.write_bytes(content), message)
            for content, message in {
                b"lr: 0.002\nsteps: 1500\n": "is not a file of weights",
                b"PK\x03\x04 and no more": "is not a plain checkpoint",
                b"\x80\x02": "is not a plain checkpoint",
                b"\x80\x05": "is not a file of weights",
                b"\x08\0\0\0\0\0\0\0[1,2,3] ": "is not a file of weights",
                b'{"epoch": 20}': "is not a file of weights",
            }.items()
        ),
        *(
            (lambda path, content=content: torch.save(content, path), "contains no named tensors")
            for content in ([1, 2], {"state_dict": {"epoch": 3}}, {}, torch.zeros(3))
        ),
        *(
            (with_notes(text), "is not a file of weights")
            for text in ("{", "tiny", "[1]", '"tiny"', "3")
        ),
        *(
            (cut_off(write, share), "is not ")
            for share in (0.0, 0.001, 0.3, 0.999)
            for write in (
                lambda path: write_weights(path, V2XFormer(small_config()).state_dict(), META),
                lambda path: torch.save(V2XFormer(small_config()).state_dict(), path),
            )
        ),
    ],
)
def test_other_files_than_weights_are_refused(
    tmp_path: Path, write: Callable[[Path], object], message: str
) -> None:
    path = tmp_path / "weights.pth"
    write(path)
    assert_unreadable(path, message)


def test_the_best_weights_of_a_run_are_read(tmp_path: Path) -> None:
    assert_raises(
        (lambda: read_weights(tmp_path), ConfigError, r"best\.safetensors: weights cannot be read")
    )

    for name in (FINAL_FILE, BEST_FILE):
        write_weights(tmp_path / name, {name: torch.ones(2)}, META)
        weights = read_weights(tmp_path)
        assert (weights.path, list(weights.tensors)) == (tmp_path / name, [name])


def test_official_swin_weights_go_into_the_image_encoder(tmp_path: Path) -> None:
    """Microsoft names its tensors otherwise; the parity tests compare the order of tokens."""
    config = small_config()
    cameras = replace(
        config.cameras,
        encoder=SwinConfig(embed_dims=8, depths=(1, 1), num_heads=(1, 1), out_stages=(0, 1)),
        lift=replace(config.cameras.lift, stride=4, in_channels=512),
    )
    model = V2XFormer(replace(config, cameras=cameras))
    official_tensors = {
        "patch_embed.proj.weight": torch.full((8, 3, 4, 4), 2.0),
        "norm.weight": torch.zeros(16),
    }
    path = tmp_path / "swin.pth"
    torch.save({"model": official_tensors}, path)

    report = load_weights(model, read_weights(path))

    assert report.unused == ("img_backbone.norm.weight",)
    assert (model.state_dict()["img_backbone.patch_embed.projection.weight"] == 2).all()
