"""From a model's maps to instances: `heads`, `grouping` (centres, pixels), `linking` (ids over time), `redrawing`."""
