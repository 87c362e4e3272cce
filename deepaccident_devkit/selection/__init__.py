"""Selecting scenarios by their attributes, and lists of samples.

Attributes select in `da.find(...)`, `--where` and the groups of `--by`.

**Fields.** A filter names a column of the scenario table, or a field that is derived from the
table; `deepaccident info --fields` lists them with their values. `--by` of `deepaccident evaluate`
takes fields with few values, and `accident_visibility` of each sample.

**Moving pairs** are pairs of `da.interactions` with both actors faster than 0.5 m/s at some frame:
a car that passes parked cars is left out, one that hits a waiting car is not. The sign of a
post-encroachment time does not count. A scenario without near moving pairs has infinite `min_…`
and a `max_drac` of 0; without labels they are unknown. Values that are not cached yet are computed
in parallel.

**Values.** One value, or a list, tuple or set of values, one of which must match; numpy's scalars
count as Python's, an array is given as a list (`array.tolist()`). In words, case, `_`, `-` and
blanks do not count. Numbers can be texts, too: `"40..60"` (both ends count; either may be left
out), `">=50"`, `">50"`, `"<=50"`, `"<50"`. None, or the text `unknown` or `none`, stands for an
unknown value; no other value or range matches it. All filters of a call must hold. For any other
test, choose among the records: `[record for record in da.find(town="Town03") if
record["num_frames"] % 2]`.

**Texts.** A filter may also be written as one text, which `--where` takes: `town=Town03,Town05`
(any of), `weather!=Clear` (all that `weather=Clear` leaves out, also unknown ones),
`length=40..60,80`, `length>=50`. Blanks around the sign and the commas do not count.

An unknown field is a FieldError, an impossible value of a field a ChoiceError; both name the
possible ones. A value that the complete release knows, but not the present part of it, is not an
error: it matches nothing.
"""

from deepaccident_devkit.selection.conditions import Filter, FilterValue, parse_where
from deepaccident_devkit.selection.query import find

__all__ = [
    "Filter",
    "FilterValue",
    "find",
    "parse_where",
]
