"""Selecting scenarios by their attributes (`da.find(...)`, `--where`, the groups of `--by`), and lists of samples.

**Fields.** A filter names a column of the scenario table, or something that is derived from the table; `deepaccident
info --fields` lists them with their values. `--by` of `deepaccident evaluate` takes those of few values, and
`accident_visibility` of each sample.

**Moving pairs** are those of `da.interactions` of which each moves faster than 0.5 m/s at some frame: who passes parked
cars is left out, who hits a car that waits is not. The sign of a post-encroachment time does not count. A scenario in
which no such pair comes near each other has infinite `min_…` and a `max_drac` of 0; without labels they are unknown.
What is not kept yet is computed in parallel.

**Values.** One value, or a list, tuple or set of values, one of which must match; numpy's scalars count as Python's, an
array is given as a list (`array.tolist()`). In words, case, `_`, `-` and blanks do not count. Numbers also as texts:
`"40..60"` (both ends count; one may be left out), `">=50"`, `">50"`, `"<=50"`, `"<50"`. None, or the text `unknown` or
`none`, stands for a value that is not known; no other value or range matches those. All filters of a call must hold.
For any other test, choose among the records: `[each for each in da.find(town="Town03") if each["num_frames"] % 2]`.

**Texts.** A filter may also be written as one text, which is what `--where` takes: `town=Town03,Town05` (any of),
`weather!=Clear` (all that `weather=Clear` leaves out, unknown ones too), `length=40..60,80`, `length>=50`. Blanks
around the sign and the commas do not count.

A field that does not exist is a FieldError, a value that the field cannot have a ChoiceError; both name what is
possible. A value that the whole release knows, but not the part that is here, is not an error: it matches nothing.
"""

from deepaccident_devkit.selection.conditions import Filter, FilterValue, parse_where
from deepaccident_devkit.selection.query import find

__all__ = [
    "Filter",
    "FilterValue",
    "find",
    "parse_where",
]
