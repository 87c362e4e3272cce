"""A scenario in words: the file's metadata, a log, and the countdown to the impact."""

from __future__ import annotations

import json
from typing import Any, Final

from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.wrappers_pb2 import DoubleValue

from deepaccident_devkit._version import __version__
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.export.mcap.moment import Moment
from deepaccident_devkit.export.mcap.recording import Recording, frame_timestamp
from deepaccident_devkit.release.fingerprints import fingerprint, scenario_hashes
from deepaccident_devkit.tables.tokens import frame_token

METADATA: Final = "deepaccident_devkit"
_LOG_EVERY: Final = 5
"""Frames (0.1 s) between two lines of the countdown."""
_SHOWN: Final = ("town", "weather", "time_of_day", "road_type", "split", "accident_type")


def scenario_metadata(dataset: Dataset, scenario: str) -> dict[str, str]:
    """The file's metadata: the devkit's version, the scenario, a hash of its label, meta and calib files."""
    record = dataset.get("scenario", scenario)
    return {
        "devkit_version": __version__,
        "release_version": dataset.version,
        "scenario": scenario,
        "fingerprint": fingerprint(scenario_hashes(dataset, [scenario], workers=1)),
        "collision": json.dumps(record["collision"], sort_keys=True),
        **{name: str(record[name]) for name in _SHOWN if record[name] is not None},
    }


class Story:
    """Writes into a log what happens, and, if there is an impact, a countdown to it."""

    def __init__(self, dataset: Dataset, scenario: str) -> None:
        """Prepare the facts of a scenario."""
        self._dataset = dataset
        self._record: Any = dataset.get("scenario", scenario)
        self._told = False

    def write(self, moment: Moment, recording: Recording) -> None:
        """Write the countdown of a moment; at the first moment, the scenario's facts before it."""
        if not self._told:
            self._told = True
            _log(self._facts(), moment.index, recording)
        left = self._dataset.get("frame", frame_token(moment.scenario, moment.index))["time_to_impact"]
        if left is None:
            return
        recording.write("/time_to_impact", DoubleValue(value=left), moment.index)
        if left == 0:
            _log(f"impact: {self._pair()}", moment.index, recording, Log.ERROR)
        elif round(left * 10) % _LOG_EVERY == 0:
            _log(f"{left:.1f} s to the impact", moment.index, recording)

    def _facts(self) -> str:
        told = ", ".join(f"{name} {self._record[name]}" for name in _SHOWN if self._record[name] is not None)
        ending = f"ends in an accident: {self._pair()}" if self._record["collision"] else "no collision is known"
        return f"{self._record['token']}: {told}; {ending}"

    def _pair(self) -> str:
        collision = self._record["collision"]
        return " and ".join(
            f"{kind} {actor}" for kind, actor in zip(collision["classes"], collision["ids"], strict=True)
        )


def _log(text: str, index: int, recording: Recording, level: int = Log.INFO) -> None:
    message = Log(timestamp=frame_timestamp(index), level=level, message=text, name=METADATA)
    recording.write("/log", message, index)
