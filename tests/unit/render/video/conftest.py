"""A small video of an accident."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from video_views import SIZE, grey

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.video import render_scenario_video


@pytest.fixture(scope="session")
def accident(da: DeepAccident) -> str:
    return next(record["token"] for record in da.scenario if record["collision"])


@pytest.fixture
def video(da: DeepAccident, accident: str, tmp_path: Path) -> Callable[..., Path]:
    """Write a small video; `name` is the file's."""

    def write(name: str, **options: Any) -> Path:
        return render_scenario_video(
            da, accident, tmp_path / name, **{"what": grey, "size": SIZE, "progress": False, **options}
        )

    return write
