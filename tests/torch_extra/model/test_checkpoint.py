"""Weights in files: ours bit for bit, foreign ones by their names, and files that are none."""

import pickle
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import assert_refused
from safetensors.torch import save_file
from torch_extra.compared import same
from torch_extra.model.small_model import small, small_released

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


def model(seed: int) -> V2XFormer:
    """The small one with other weights for each seed."""
    torch.manual_seed(seed)
    return V2XFormer(small())


def trained_alone(model: torch.nn.Module) -> dict[str, torch.Tensor]:
    """What training changes, and a file must have."""
    return {
        name: each
        for name, each in model.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }


def test_weights_come_back_bit_for_bit(tmp_path: Path) -> None:
    first, second, path = model(0), model(1), tmp_path / "weights.safetensors"
    write_weights(path, first.state_dict(), META)
    weights, before = read_weights(path), path.read_bytes()
    assert same([weights.meta, dict(weights.tensors)], [META, dict(first.state_dict())])
    load_weights(second, weights, whole=True)
    assert same(trained_alone(first), trained_alone(second))
    write_weights(path, first.state_dict(), META)
    assert {each: each.read_bytes() for each in tmp_path.iterdir()} == {path: before}


def test_weights_of_another_preset_name_the_keys(tmp_path: Path) -> None:
    path = tmp_path / "released.safetensors"
    write_weights(path, V2XFormer(small_released()).state_dict(), META | {"preset": "released"})
    told = (
        rf"\A{re.escape(str(path))}: weights of the preset 'released' do not fit this model: "
        r"[^\n]*img_backbone\.fine\.0\.0\.weight[^\n]*img_backbone\.norm2\.bias[^\n]*"
        r"; give the preset and the options that they were trained with\Z"
    )
    assert_refused((lambda: load_weights(model(0), read_weights(path)), ConfigError, told))


def test_other_shapes_are_told(tmp_path: Path) -> None:
    path, fresh, changed = tmp_path / "tiny.safetensors", model(1), dict(model(0).state_dict())
    name = next(each for each in changed if each.endswith("weight"))
    changed[name] = changed[name][:1]
    write_weights(path, changed, META)
    told = rf"1 tensors have another shape \({re.escape(name)} is \(1, .*, not \("
    assert_refused((lambda: load_weights(fresh, read_weights(path)), ConfigError, told))
    assert same(fresh.state_dict(), model(1).state_dict())  # nothing was loaded by halves


def test_what_is_missing_begins_at_random_unless_all_are_needed(tmp_path: Path) -> None:
    path, others, other = (
        tmp_path / "part.safetensors",
        tmp_path / "other.safetensors",
        {"other.weight": torch.zeros(2)},
    )
    part = {name: each for name, each in model(0).state_dict().items() if name.startswith("img_")}
    write_weights(path, part | other, {})
    write_weights(others, other, {})
    weights, fresh = read_weights(path), model(1)
    done = load_weights(fresh, weights)
    assert done.unused == ("other.weight",)
    assert not any(name.startswith("img_") for name in done.unchanged)
    assert same(
        *[{name: each.state_dict()[name] for name in done.unchanged} for each in (fresh, model(1))]
    )
    lacking, strange = (
        r"weights do not fit this model: \d+ of the model are missing",
        r"not the model's \(other\.weight",
    )
    assert_refused(
        (lambda: load_weights(fresh, weights, whole=True), ConfigError, lacking),
        (lambda: load_weights(fresh, read_weights(others)), ConfigError, strange),
    )


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("prefix", ["", "module."])
@pytest.mark.parametrize("wrapped", [True, False])
def test_foreign_checkpoints_have_our_names(
    tmp_path: Path, *, zipped: bool, prefix: str, wrapped: bool
) -> None:
    """Of mmcv, with or without what it wraps around them; new and old files of torch."""
    path = tmp_path / "epoch_20.pth"
    tensors: Any = {f"{prefix}{name}": each for name, each in model(0).state_dict().items()}
    content = (
        {"meta": {"epoch": 20, "config": "text"}, "state_dict": tensors} if wrapped else tensors
    )
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    weights, fresh = read_weights(path), model(1)
    assert weights.meta == {}
    load_weights(fresh, weights, whole=True)
    assert same(trained_alone(fresh), trained_alone(model(0)))


def test_the_release_s_further_layers_are_told(tmp_path: Path) -> None:
    """Its dead V2X layers, and BEVerse's map task."""
    first, second, path = (
        V2XFormer(small_released()),
        V2XFormer(small_released()),
        tmp_path / "beverse.pth",
    )
    further = {
        "v2x_fusion.model.0.conv.weight": torch.zeros(2),
        "v2x_fusion.compression.0.weight": torch.zeros(2),
        "pts_bbox_head.taskfeat_encoders.map.layer.weight": torch.zeros(2),
        "pts_bbox_head.task_decoders.map.layer.weight": torch.zeros(2),
        "img_backbone.stages.0.blocks.0.attn.w_msa.relative_position_index": torch.zeros(16, 16),
    }
    torch.save({"state_dict": dict(first.state_dict()) | further}, path)
    done = load_weights(second, read_weights(path), whole=True)
    assert same(trained_alone(first), trained_alone(second))
    assert sorted(done.unused) == sorted(list(further)[:4])


class Opens:
    """What a malicious file would do: write a file while it is read."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("how", ["pickle", "torch", "old torch"])
def test_code_in_a_file_is_refused_and_not_run(tmp_path: Path, how: str) -> None:
    path, written = tmp_path / "weights.pth", tmp_path / "written"
    content = {"state_dict": {"img_neck.weight": torch.zeros(1)}, "meta": Opens(written)}
    if how == "pickle":
        path.write_bytes(pickle.dumps(content, protocol=2))
    else:
        torch.save(content, path, _use_new_zipfile_serialization=how == "torch")
    assert_unreadable(path, "is no plain checkpoint")
    assert not written.exists()


def assert_unreadable(path: Path, message: str) -> None:
    """It is refused in one line, which ends with a remedy."""
    told = rf"\A{re.escape(f'{path}: {message}')}[^\n]*; give [^\n]*\Z"
    assert_refused((lambda: read_weights(path), ConfigError, told))


def noted(text: str) -> Callable[[Path], None]:
    """A file of ours with these notes."""
    return lambda path: save_file(
        {"img_neck.weight": torch.zeros(1)}, path, metadata={"deepaccident": text}
    )


def cut(write: Callable[[Path], object], share: float) -> Callable[[Path], None]:
    """This share of a file."""

    def make(path: Path) -> None:
        write(path)
        path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])

    return make


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda _: None, "weights cannot be read (No such file or directory)"),
        *(
            (lambda path, content=content: path.write_bytes(content), message)
            for content, message in {
                b"lr: 0.002\nsteps: 1500\n": "is no file of weights",
                b"PK\x03\x04 and no more": "is no plain checkpoint",
                b"\x80\x02": "is no plain checkpoint",
                b"\x80\x05": "is no file of weights",
                b"\x08\0\0\0\0\0\0\0[1,2,3] ": "is no file of weights",
                b'{"epoch": 20}': "is no file of weights",
            }.items()
        ),
        *(
            (lambda path, content=content: torch.save(content, path), "holds no tensors by name")
            for content in ([1, 2], {"state_dict": {"epoch": 3}}, {}, torch.zeros(3))
        ),
        *((noted(text), "is no file of weights") for text in ("{", "tiny", "[1]", '"tiny"', "3")),
        *(
            (cut(write, share), "is no ")
            for share in (0.0, 0.001, 0.3, 0.999)
            for write in (
                lambda path: write_weights(path, V2XFormer(small()).state_dict(), META),
                lambda path: torch.save(V2XFormer(small()).state_dict(), path),
            )
        ),
    ],
)
def test_what_is_no_file_of_weights_is_refused(
    tmp_path: Path, make: Callable[[Path], object], message: str
) -> None:
    """Absent, another file, nothing by name, notes that are no JSON object, cut off."""
    path = tmp_path / "weights.pth"
    make(path)
    assert_unreadable(path, message)


def test_of_a_run_the_best_weights_are_read(tmp_path: Path) -> None:
    assert_refused(
        (lambda: read_weights(tmp_path), ConfigError, r"best\.safetensors: weights cannot be read")
    )
    for name in (FINAL_FILE, BEST_FILE):
        write_weights(tmp_path / name, {name: torch.ones(2)}, META)
        weights = read_weights(tmp_path)
        assert (weights.path, list(weights.tensors)) == (tmp_path / name, [name])


def test_official_swin_weights_go_into_the_image_encoder(tmp_path: Path) -> None:
    """Microsoft's names, under `model`; the parity tests compare the order of tokens."""
    encoder, cameras = (
        SwinConfig(embed_dims=8, depths=(1, 1), num_heads=(1, 1), out_stages=(0, 1)),
        small().cameras,
    )
    cameras = replace(
        cameras, encoder=encoder, lift=replace(cameras.lift, stride=4, in_channels=512)
    )
    model, path = V2XFormer(replace(small(), cameras=cameras)), tmp_path / "swin.pth"
    official = {
        "patch_embed.proj.weight": torch.full((8, 3, 4, 4), 2.0),
        "norm.weight": torch.zeros(16),
    }
    torch.save({"model": official}, path)
    done = load_weights(model, read_weights(path))
    assert done.unused == ("img_backbone.norm.weight",)
    assert (model.state_dict()["img_backbone.patch_embed.projection.weight"] == 2).all()
