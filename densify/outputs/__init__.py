# SPDX-License-Identifier: MIT
"""Write the files of a result, each whole or absent, their exports and the report page."""

from densify.outputs.cloud_files import StoredCloud, read_cloud, write_cloud
from densify.outputs.depth_png import (
    read_depth_png,
    read_mask_png,
    write_age_png,
    write_confidence_png,
    write_depth_png,
)
from densify.outputs.export import Export, export_run
from densify.outputs.key_outputs import check_writable, write_comparison, write_result

__all__ = [
    "Export",
    "StoredCloud",
    "check_writable",
    "export_run",
    "read_cloud",
    "read_depth_png",
    "read_mask_png",
    "write_age_png",
    "write_cloud",
    "write_comparison",
    "write_confidence_png",
    "write_depth_png",
    "write_result",
]
