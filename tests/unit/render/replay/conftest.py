"""A replay, and predictions to show in one."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from replay_page import accident, data_of

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, box_truth
from deepaccident_devkit.render.replay import render_replay


@pytest.fixture(scope="session")
def page(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "new folder" / "replay.html"
    assert render_replay(da, accident(da), path) == path
    return path


@pytest.fixture(scope="session")
def data(page: Path) -> dict[str, Any]:
    return data_of(page)


def foreseen(dataset: DeepAccident, token: str, *, away: float = 0.0, **other: Any) -> Accident:
    """The true accident of a sample, so many metres away, or with other numbers."""
    truth = box_truth(dataset, token).accident
    told = {
        "positions": truth.positions + np.array([away, 0.0]),
        "time": truth.time,
        "ids": truth.ids,
        **other,
    }
    return Accident(**told)


@pytest.fixture(scope="session")
def predictions(da_motion: DeepAccident) -> dict[str, list[Accident]]:
    ego = f"{accident(da_motion)}/ego_vehicle"
    return {
        f"{ego}/020": [foreseen(da_motion, f"{ego}/020", score=0.75)],
        f"{ego}/025": [foreseen(da_motion, f"{ego}/025", away=20.0)],
        f"{ego}/030": [],
        f"{accident(da_motion)}/infrastructure/030": [
            foreseen(da_motion, f"{ego}/030", away=90.0, ids=None),
            *(
                Accident(positions=np.full((2, 2), far), time=1.0, score=0.1)
                for far in (200.0, 300.0, 400.0)
            ),
        ],
    }
