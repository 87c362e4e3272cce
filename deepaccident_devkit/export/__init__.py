"""The dataset in the formats of other frameworks; each needs an extra of its own."""
