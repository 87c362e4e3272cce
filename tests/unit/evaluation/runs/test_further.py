"""Results that a room of the ring adds to runs: looked up by name, and named where the room is not installed."""

import pytest
from refusals import assert_refused

from deepaccident_devkit import rooms
from deepaccident_devkit.errors import MissingRoomError
from deepaccident_devkit.evaluation import runs
from deepaccident_devkit.evaluation.runs.further import further_results


def test_a_missing_room_is_named_and_other_names_are_no_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rooms, "find_spec", lambda _: None)
    assert_refused(
        (lambda: list(further_results({"prevented": {"notes": []}})), MissingRoomError, ("prevented: ", "`safety`")),
        (lambda: runs.with_prevented, MissingRoomError, ("evaluation.runs.with_prevented", "`safety`")),
        (lambda: runs.mine, AttributeError, ("deepaccident_devkit.evaluation.runs", "'mine'")),
    )
    assert not list(further_results({"metrics": {}, "prevented": {}}))
