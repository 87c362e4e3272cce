"""Fixtures that several tests of readers need."""

from collections.abc import Callable

import numpy as np
import pytest
from support.strategies import rotation_matrix

from deepaccident_devkit.release.calib import KEYS


@pytest.fixture(scope="session")
def raw_calib() -> dict[str, np.ndarray]:
    """Return the content of a calib file; its arrays all differ and none is symmetric."""
    raw = {}
    for number, (key, shape) in enumerate(KEYS.items(), start=1):
        if shape == (4, 4):
            pose = np.eye(4)
            pose[:3, :3] = rotation_matrix(0.3 * number, 0.1, -0.2)
            pose[:3, 3] = number, -2.5, 0.3
            raw[key] = pose
        else:
            focal = 1000 + number
            raw[key] = np.array([[800.0, focal, 0], [450, 0, -focal], [1, 0, 0]])
    return raw


@pytest.fixture(scope="session")
def outcome() -> Callable:
    """Return a function that calls a reader and returns its result and None, or None and the
    message of its error.

    Errors of any other kind escape.
    """

    def call_reader(kind: type[Exception], reader: Callable, *arguments: object) -> tuple:
        try:
            return reader(*arguments), None
        except kind as error:
            return None, str(error)

    return call_reader
