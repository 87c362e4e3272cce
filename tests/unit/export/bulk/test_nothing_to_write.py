"""An export in which nothing could be written says so before it makes a folder."""

from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.export.bulk import Format, export_release
from deepaccident_devkit.export.image_cache import CachedImages
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.export.questions import Questions
from deepaccident_devkit.export.released_infos import ReleasedInfos
from deepaccident_devkit.export.webdataset import WebDataset

ABSENT = ("infrastructure",)
IMAGES = ImageConfig(resize=(9, 16), cameras=("Camera_Back",))


@pytest.mark.parametrize(
    ("form", "told"),
    [
        (ReleasedInfos(), r"in the split files train\.txt or val\.txt .*; add these files, or choose other scenarios"),
        (OpenCood(), "has its point clouds; unpack the archives of lidar01"),
        (CachedImages(split="train", images=IMAGES), "none of these images is in this release; unpack"),
        (Questions(agents=ABSENT), "no recording is long enough"),
        (OpenCood(agents=ABSENT, without_clouds=True), "no moment"),
        *((kind(agents=ABSENT), "no chosen agent recorded one of") for kind in (NuScenes, Parquet, WebDataset)),
    ],
)
@pytest.mark.parametrize("dry_run", [False, True])
def test_nothing_to_write(small: DeepAccident, tmp_path: Path, form: Format, told: str, dry_run: bool) -> None:
    with pytest.raises(NotAvailableError, match=told):
        export_release(small, tmp_path / "out", form, workers=1, dry_run=dry_run)
    assert not list(tmp_path.iterdir())
