"""The dataset in other frameworks' forms; each needs an extra of its own."""
