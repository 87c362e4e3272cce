"""The dataset in the formats of other frameworks; each needs its own extra."""
