"""Unpack a release of labels, meta and calib files from one npz (tests/data/golden/windows)."""

from pathlib import Path

import numpy as np

from deepaccident_devkit.release import write_raw_calib


def unpack_release(packed_path: Path, root: Path) -> Path:
    """Write the files of a packed release below `root`, and return it."""
    with np.load(packed_path) as archive:
        packed = dict(archive)
    text = packed["text"].tobytes()
    ends = packed["ends"].tolist()
    starts = [0, *ends[:-1]]
    for name, start, end in zip(packed["names"].tolist(), starts, ends, strict=True):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text[start:end])
    calib = {}
    for name, array in packed.items():
        if name.startswith("calib_") and name != "calib_names":
            calib[name.removeprefix("calib_")] = array
    for row, name in enumerate(packed["calib_names"].tolist()):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_raw_calib(path, {key: array[row] for key, array in calib.items()})
    return root
