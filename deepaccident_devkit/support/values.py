"""Names for mappings whose values differ in type: rows, records, settings and JSON objects.

The signatures of public functions spell these types out, so that their pages need no second look.
"""

from collections.abc import Mapping
from typing import Any

NamedValues = dict[str, Any]
ReadOnlyValues = Mapping[str, Any]
