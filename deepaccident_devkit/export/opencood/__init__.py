"""The folders of OPV2V and V2XSet, which OpenCOOD, V2X-ViT, CoAlign and HEAL read.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.opencood import OpenCood

    da = DeepAccident(dataroot="data/DeepAccident")
    export_release(da, "data/opv2v", OpenCood(split="val"))

docs/exports.md says what becomes what, and what is lost.
"""

from deepaccident_devkit.export.opencood.format import OpenCood

__all__ = ["OpenCood"]
