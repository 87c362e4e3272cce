"""What several tests of readers need."""

from collections.abc import Callable

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


@pytest.fixture(scope="session")
def outcome() -> Callable:
    """Call a reader: what it returns and None, or None and what its error of this kind says; no
    other may escape.
    """

    def call(kind: type[Exception], reader: Callable, *arguments: object) -> tuple:
        try:
            return reader(*arguments), None
        except kind as error:
            return None, str(error)

    return call
