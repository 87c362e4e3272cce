"""Read the data of a replay's page, and choose the scenarios that it shows."""

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

from PIL import Image

from deepaccident_devkit import DeepAccident


def accident_scenario(dataset: DeepAccident) -> str:
    """Return the token of the first scenario that ends in a collision."""
    return next(scenario["token"] for scenario in dataset.scenario if scenario["collision"])


def normal_scenario(dataset: DeepAccident) -> str:
    """Return the token of the first scenario without a collision."""
    return next(scenario["token"] for scenario in dataset.scenario if not scenario["collision"])


def read_page_data(page: Path | str) -> dict[str, Any]:
    """Parse the JSON that a page, given as a file or as its text, contains."""
    html = page if isinstance(page, str) else page.read_text(encoding="utf-8")
    pattern = r'<script type="application/json" id="data">(.*?)</script>'
    (json_text,) = re.findall(pattern, html, re.DOTALL)
    data: dict[str, Any] = json.loads(json_text)
    return data


def decode_image(encoded: str) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(encoded)))
