"""Loaders with workers that read a release in a zip."""

from pathlib import Path

import pytest
from support.zipped_releases import zip_release
from torch.utils.data import DataLoader
from torch_extra.compared import are_identical

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.training.torch import ImageConfig, V2XConfig, V2XDataset, collate


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_two_workers_read_a_zip(
    method: str, da: DeepAccident, release_root: Path, tmp_path: Path
) -> None:
    path = zip_release(release_root, tmp_path / "all.zip")
    zipped_da = DeepAccident(dataroot=path, workers=1, verbose=False)
    tokens = [da.sample[number]["token"] for number in (1, 4, 8)]
    config = V2XConfig(agents="+infrastructure", images=ImageConfig(resize=(18, 32)))
    expected = list(DataLoader(V2XDataset(da, tokens, config), collate_fn=collate))

    data = V2XDataset(zipped_da, tokens, config)
    data[0]  # opens the archive before the fork
    loader = DataLoader(
        data,
        collate_fn=collate,
        num_workers=2,
        multiprocessing_context=method,
    )

    assert are_identical(list(loader), expected)
