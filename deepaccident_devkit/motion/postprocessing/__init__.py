"""From a model's maps to instances: `grouping` (heads, centres, pixels, ids over time), `contours` (redrawing)."""
