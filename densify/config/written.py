# SPDX-License-Identifier: MIT
"""The plug-ins that write: outputs of ``run`` (functions as `densify.outputs.store.WriteOutput`),
and forms of ``export`` (as `densify.outputs.export.WriteExport`)."""

from __future__ import annotations

from densify.config.errors import InputError
from densify.config.plugins import Plugin, Table

_KEY, _PLOTS, _PLAIN, _CAMERAS = "key_outputs", "plots", "maps_and_clouds", "camera_files"


def _output(name: str, module: str, *owned: str, function: str = "") -> Plugin:
    path = module if "." in module else f"densify.outputs.{module}"
    return Plugin(name, path, function=function or f"write_{name}", owned=owned)


def _export(name: str, module: str, *owned: str, of_drive: bool = False) -> Plugin:
    path, function = f"densify.outputs.export.{module}", f"write_{name}"
    return Plugin(name, path, function=function, owned=owned, of_drive=of_drive)


OUTPUTS = Table(
    "output",
    "densify.outputs",
    ("write_output",),
    (
        _output("depth", _KEY, "depth", "depth_filled", "confidence", "age"),
        _output("full", _KEY, "depth_full", "confidence_full"),
        _output("flow", "flow_writers", "flow"),
        _output("movers", _KEY, "movers"),
        _output("tracks", _KEY, "movers.json"),
        _output("optical_flow", _KEY, "optical_flow"),
        _output("cloud", _KEY, "cloud.laz", function="write_cloud_laz"),
        _output("scene", _KEY, "scene"),
        _output("metrics", _KEY, "metrics.json"),
        _output("figure", _PLOTS, "figure.png", function="write_key_figure"),
        _output("curve", _PLOTS, "curve.png"),
        _output("run", _KEY, "run.yaml", function="write_run_yaml"),
        # Last, because it reads what the others wrote.
        _output("report", "densify.dataset.report", "report.html", function="write_output"),
    ),
)

EXPORTS = Table(
    "export",
    "densify.exports",
    ("write_export",),
    (
        _export("npy", _PLAIN, "depth", "depth_filled", "confidence"),
        _export("exr", _PLAIN, "depth", "depth_filled", "confidence"),
        _export("ply", _PLAIN, "cloud.ply"),
        _export("pcd", _PLAIN, "cloud.pcd"),
        _export("nerfstudio", _CAMERAS, "transforms.json", "images", "depth", "cloud.ply"),
        _export("colmap", _CAMERAS, "images", "sparse"),
        _export("splats", _CAMERAS, "images", "sparse", "movers", "tracks.json"),
        _export("kitti", _PLAIN, "train", "val", of_drive=True),
        _export("rrd", "rrd", "recording.rrd", of_drive=True),
        _export("mcap", "mcap", "recording.mcap", of_drive=True),
    ),
)


def check_also(also: str) -> None:
    """Raise InputError unless ``also`` is a list of outputs, parted by commas. Imports none."""
    for name in _names(also):
        OUTPUTS.require(name, "output.also")


def chosen_outputs(also: str) -> list[Plugin]:
    """Return the built-in outputs, then those that ``also`` names, which are imported.

    Raises InputError for a name that is none, and for outputs that own the same file.
    """
    rows = list(OUTPUTS.built_in)
    for name in _names(also):
        row = OUTPUTS.row(name, "output.also")
        if row in rows:
            continue
        if not row.owned:
            raise InputError(f"output {name}: {row.module} says no OWNED; mend its package")
        for other in rows:
            if both := sorted({*row.owned} & {*other.owned}):
                raise InputError(
                    f"output.also: {name} would write {', '.join(both)} of the output "
                    f"{other.name}; leave one of them out"
                )
        rows.append(row)
    return rows


def _names(also: str) -> list[str]:
    return [word.strip() for word in also.split(",") if word.strip()]
