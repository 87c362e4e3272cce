"""The part of an export that is the same for every format: plan, folder, manifest, links, resuming."""

from deepaccident_devkit.export.bulk.format import Format, Plan, Unit, flat_name
from deepaccident_devkit.export.bulk.output import Link, Output, Tally
from deepaccident_devkit.export.bulk.run import Exported, export_release

__all__ = ["Exported", "Format", "Link", "Output", "Plan", "Tally", "Unit", "export_release", "flat_name"]
