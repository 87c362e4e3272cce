"""What the page of a replay has, and of which scenarios."""

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

from PIL import Image

from deepaccident_devkit import DeepAccident


def accident(dataset: DeepAccident) -> str:
    return next(each["token"] for each in dataset.scenario if each["collision"])


def normal(dataset: DeepAccident) -> str:
    return next(each["token"] for each in dataset.scenario if not each["collision"])


def data_of(page: Path | str) -> dict[str, Any]:
    text = page if isinstance(page, str) else page.read_text(encoding="utf-8")
    (found,) = re.findall(
        r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL
    )
    data: dict[str, Any] = json.loads(found)
    return data


def picture(coded: str) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(coded)))
