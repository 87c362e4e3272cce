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


def foresee_accident(
    dataset: DeepAccident, token: str, *, offset_m: float = 0.0, **changes: Any
) -> Accident:
    """Predict the true accident of a sample, some metres away or with other values."""
    truth = box_truth(dataset, token).accident
    values = {
        "positions": truth.positions + np.array([offset_m, 0.0]),
        "time": truth.time,
        "ids": truth.ids,
        **changes,
    }
    return Accident(**values)


@pytest.fixture(scope="session")
def predictions(da_motion: DeepAccident) -> dict[str, list[Accident]]:
    """Alarms by sample: one correct, one far away, none, and four far away."""
    scenario = accident_scenario(da_motion)
    ego = f"{scenario}/ego_vehicle"
    unlikely_alarms = [
        Accident(positions=np.full((2, 2), position_m), time=1.0, score=0.1)
        for position_m in (200.0, 300.0, 400.0)
    ]
    return {
        f"{ego}/020": [foresee_accident(da_motion, f"{ego}/020", score=0.75)],
        f"{ego}/025": [foresee_accident(da_motion, f"{ego}/025", offset_m=20.0)],
        f"{ego}/030": [],
        f"{scenario}/infrastructure/030": [
            foresee_accident(da_motion, f"{ego}/030", offset_m=90.0, ids=None),
            *unlikely_alarms,
        ],
    }
