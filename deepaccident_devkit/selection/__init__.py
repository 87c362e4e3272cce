"""Finding scenarios by their attributes: `da.find(...)`, the texts of `--where`, and whether an accident can be seen.

**Fields.** A filter names a field of the scenario table, or one that is derived from it:

| field | values |
|---|---|
| `name`, `scenario_type` (short: `type`) | as the release names them |
| `town`, `weather`, `time_of_day` | `Town03`; `HardRain`; `Noon`, `Sunset`, `Night` |
| `road_type`, `spawn_side` | `four-way junction`, `three-way junction`; `left`, `right`, `opposite` |
| `ego_direction`, `other_direction` | `straight`, `left`, `right` |
| `split` | `train`, `val`, `test` |
| `signalized`, `designed_accident` | true, false: traffic lights; an `_accident` folder |
| `collision` | true, false: whether meta names a collision; unknown without meta |
| `accident_type` | 1 to 12, the paper's design that the accident realises; unknown (none) for any other end |
| `num_frames` (short: `length`) | recorded frames |
| `visibility` | `visible`, `partial`, `invisible`: whether ego sees the accident coming (see `accident_visibility`) |

**Values.** One value, or a list, tuple or set of values, one of which must match; numpy's scalars count as Python's, an
array is given as a list (`array.tolist()`). Numbers also as texts: `"40..60"` (both
ends count; one may be left out), `">=50"`, `">50"`, `"<=50"`, `"<50"`. None, or the text `unknown` or `none`, stands
for a value that is not known; no other value or range matches those. All filters of a call must hold.

**Texts.** A filter may also be written as one text, which is what `--where` takes: `town=Town03,Town05` (any of),
`weather!=Clear` (all that `weather=Clear` leaves out, unknown ones too), `length=40..60,80`, `length>=50`. Blanks
around the sign and the commas do not count.

A field that does not exist is a FieldError, a value that the field cannot have a ChoiceError; both name what is
possible. A value that the whole release knows, but not the part that is here, is not an error: it matches nothing.
"""

from deepaccident_devkit.selection.accident_visibility import (
    accident_visibility,
    accident_visible,
    accident_visible_mask,
    pair_in_view,
)
from deepaccident_devkit.selection.conditions import Filter, FilterValue, parse_where
from deepaccident_devkit.selection.query import find

__all__ = [
    "Filter",
    "FilterValue",
    "accident_visibility",
    "accident_visible",
    "accident_visible_mask",
    "find",
    "pair_in_view",
    "parse_where",
]
