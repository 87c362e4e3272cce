from functools import partial
from pathlib import Path
from typing import Any

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError, UnfinishedError
from deepaccident_devkit.parallel import Shard
from deepaccident_devkit.safety.bulk import Survey


def _length(least: int, dataset: Dataset, scenario: str) -> dict[str, Any] | None:
    record = dataset.get("scenario", scenario)
    if record["collision"] is None:
        return None
    if record["num_frames"] < least:
        raise NotAvailableError(f"{scenario}: too short")
    return {"scenario": scenario, "frames": record["num_frames"], "unknown": float("inf")}


def _survey(dataset: Dataset, least: int = 0) -> Survey:
    return Survey(
        dataset=dataset,
        ask=partial(_length, least),
        scenarios=[each["token"] for each in dataset.scenario],
        settings=f"length {least}",
    )


def test_every_scenario_is_answered_skipped_or_not_concerned(da_b: DeepAccident) -> None:
    accidents = [each["token"] for each in da_b.find(collision=True)]
    found = _survey(da_b).run(workers=1)
    assert [each["scenario"] for each in found.records] == accidents
    assert (found.skipped, found.without) == ((), len(da_b.scenario) - len(accidents))
    none = _survey(da_b, least=1000).run(workers=1)
    assert [each.scenario for each in none.skipped] == accidents
    assert "too short" in none.skipped[0].reason
    assert not none.records


def test_shards_merge_to_the_whole(da_b: DeepAccident, tmp_path: Path) -> None:
    survey, out = _survey(da_b), tmp_path / "report"
    assert survey.run_shard(Shard(1, 2), out, workers=1) == 3
    with pytest.raises(UnfinishedError, match="3 of 6 are not done"):
        survey.merged(out)
    survey.run_shard(Shard(2, 2), out, workers=1)
    assert survey.merged(out) == survey.run(workers=1)
    with pytest.raises(UnfinishedError, match="6 of 6"):
        _survey(da_b, least=1).merged(out)
    survey.remove_shards(out)
    assert not list(tmp_path.iterdir())


def test_a_damaged_shard_is_made_again(da_b: DeepAccident, tmp_path: Path) -> None:
    survey, out = _survey(da_b), tmp_path / "report"
    survey.run_shard(Shard(1, 1), out, workers=1)
    (file,) = tmp_path.glob("*/*.json")
    file.write_bytes(file.read_bytes()[:-5])
    with pytest.raises(UnfinishedError, match="6 of 6"):
        survey.merged(out)
    survey.run_shard(Shard(1, 1), out, workers=1)
    assert len(survey.merged(out).records) == 3
