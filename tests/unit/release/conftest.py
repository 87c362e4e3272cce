"""Calib dicts and pickles for test_calib and test_unpickle."""

import numpy as np
import pytest
from strategies import rotation_matrix

from deepaccident_devkit.release.calib import KEYS


@pytest.fixture(scope="session")
def raw_calib() -> dict[str, np.ndarray]:
    """What a calib file holds, every array another and none symmetric."""
    raw = {}
    for number, (key, shape) in enumerate(KEYS.items(), start=1):
        if shape == (4, 4):
            raw[key] = np.eye(4)
            raw[key][:3, :3] = rotation_matrix(0.3 * number, 0.1, -0.2)
            raw[key][:3, 3] = number, -2.5, 0.3
        else:
            raw[key] = np.array([[800.0, 1000 + number, 0], [450, 0, -1000 - number], [1, 0, 0]])
    return raw
