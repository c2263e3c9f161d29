# SPDX-License-Identifier: MIT
"""The outputs, each of which writes some files of one key: a function each, as
`densify.outputs.store.WriteOutput`. The module of another package has ``write_output`` and OWNED.
"""

from __future__ import annotations

from dataclasses import dataclass

from densify.config.errors import InputError
from densify.config.plugins.table import Row, Table


@dataclass(frozen=True)
class Output(Row):
    """function: of the module. owned: the files and folders in the key's folder that it alone may
    write."""

    function: str = "write_output"
    owned: tuple[str, ...] = ()


def _built_in(name: str, module: str, function: str, *owned: str) -> Output:
    return Output(name, f"densify.{module}", function, owned)


_KEY, _PLOTS = "outputs.key_outputs", "outputs.plots"

OUTPUTS = Table(
    "output",
    "densify.outputs",
    ("write_output",),
    (
        _built_in("depth", _KEY, "write_depth", "depth", "depth_filled", "confidence", "age"),
        _built_in("full", _KEY, "write_full", "depth_full", "confidence_full"),
        _built_in("flow", "outputs.flow_writers", "write_flow", "flow"),
        _built_in("movers", _KEY, "write_movers", "movers"),
        _built_in("tracks", _KEY, "write_tracks", "movers.json"),
        _built_in("optical_flow", _KEY, "write_optical_flow", "optical_flow"),
        _built_in("rejected", _PLOTS, "write_rejected", "rejected"),
        _built_in("cloud", _KEY, "write_cloud_laz", "cloud.laz"),
        _built_in("scene", _KEY, "write_scene", "scene"),
        _built_in("metrics", _KEY, "write_metrics", "metrics.json"),
        _built_in("figure", _PLOTS, "write_key_figure", "figure.png"),
        _built_in("curve", _PLOTS, "write_curve", "curve.png"),
        _built_in("run", _KEY, "write_run_yaml", "run.yaml"),
        # Last, because it reads what the others wrote.
        _built_in("report", "dataset.report", "write_output", "report.html"),
    ),
)


def check_also(also: str) -> None:
    """Raise InputError unless ``also`` is a list of outputs, parted by commas. Imports none."""
    for name in _names(also):
        OUTPUTS.require(name, "output.also")


def chosen(also: str) -> list[Output]:
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
