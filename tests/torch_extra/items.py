"""Single items of datasets."""

from typing import Any

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.training.torch import V2XConfig, V2XDataset


def load_item(dataset: DeepAccident, token: str, **fields: Any) -> dict[str, Any]:
    """Load the item of one sample under a V2XConfig with these fields."""
    return V2XDataset(dataset, [token], V2XConfig(**fields))[0]
