"""Results that plug-ins add to runs: looked up by name, and an error if the plug-in is missing."""

import pytest

from deepaccident_devkit.errors import MissingPluginError
from deepaccident_devkit.evaluation.runs.further import extra_result, further_results


def test_an_extra_result_whose_plugin_is_missing_is_named() -> None:
    with pytest.raises(MissingPluginError, match=r"^mine: needs a plug-in that is not installed"):
        list(further_results({"mine": {"interval_notes": []}}))

    assert not list(further_results({"metrics": {}, "prevented": None}))
    assert len(list(further_results({"metrics": {}, "prevented": {"groups": {}}}))) == 1
    assert extra_result("prevented").title == "prevented accidents"
