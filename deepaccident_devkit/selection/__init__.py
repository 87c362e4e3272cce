"""Selection of scenarios by their attributes, and lists of samples.

Attributes select scenarios in `da.find(...)` and `--where`, and define the groups of `--by`.

**Fields.** A filter names a column of the scenario table, or a field that is derived from the
table; `deepaccident info --fields` lists them with their values. `deepaccident evaluate --by`
accepts fields with few values, and `accident_visibility`, which is judged for each sample.

**Moving pairs** are pairs of `da.interactions` in which both actors are faster than 0.5 m/s in some
frame: a car that passes parked cars is left out, but a car that hits a waiting car is not. The sign
of a post-encroachment time is ignored. If no moving pair comes close, `min_…` is infinite and
`max_drac` is 0; without labels they are unknown. Values that are not cached yet are computed in
parallel.

**Values.** A filter has one value, or a list, tuple or set of values, and one must match.
numpy scalars are accepted; convert an array to a list (`array.tolist()`). In words, case, `_`, `-`
and blanks are ignored. Numbers can also be texts: `"40..60"` (both ends are inclusive; either may
be left out), `">=50"`, `">50"`, `"<=50"`, `"<50"`. None, or the text `unknown` or `none`, matches
unknown values; no other value or range does. A scenario must match all filters of a call. For any
other test, filter the records yourself: `[record for record in da.find(town="Town03") if
record["num_frames"] % 2]`.

**Texts.** A filter may also be written as one text, as for `--where`: `town=Town03,Town05` (any of
them), `weather!=Clear` (everything that `weather=Clear` leaves out, including unknown values),
`length=40..60,80`, `length>=50`. Blanks around the operator and the commas are ignored.

An unknown field raises FieldError, and an impossible value raises ChoiceError; both messages list
the possible ones. A value that occurs in the complete release, but not in the part that you have,
is not an error: it matches nothing.
"""

from deepaccident_devkit.selection.conditions import Filter, FilterValue, parse_where
from deepaccident_devkit.selection.query import find

__all__ = [
    "Filter",
    "FilterValue",
    "find",
    "parse_where",
]
