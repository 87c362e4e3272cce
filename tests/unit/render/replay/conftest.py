"""A replay, and predictions to show in one."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.replay_page import accident_scenario, read_page_data

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, box_truth
from deepaccident_devkit.render.replay import render_replay


@pytest.fixture(scope="session")
def page(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "new folder" / "replay.html"
    assert render_replay(da, accident_scenario(da), path) == path
    return path


@pytest.fixture(scope="session")
def data(page: Path) -> dict[str, Any]:
    return read_page_data(page)


@pytest.fixture(scope="session")
def predictions(da_motion: DeepAccident) -> dict[str, list[Accident]]:
    """Alarms by sample: one correct, none, and more than a page shows."""
    scenario = accident_scenario(da_motion)
    ego = f"{scenario}/ego_vehicle"
    truth = box_truth(da_motion, f"{ego}/020").accident
    far_alarms = [
        Accident(positions=np.full((2, 2), position_m), time=1.0, score=0.1)
        for position_m in (200.0, 300.0, 400.0, 500.0, 600.0)
    ]
    return {
        f"{ego}/020": [Accident(positions=truth.positions, time=truth.time, score=0.75)],
        f"{ego}/030": [],
        f"{scenario}/infrastructure/030": far_alarms,
    }
