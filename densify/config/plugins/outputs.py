# SPDX-License-Identifier: MIT
"""The outputs, each of which writes some files of one key. Each has the function
`densify.outputs.store.OutputModule`; the module of another package also has OWNED."""

from __future__ import annotations

from dataclasses import dataclass

from densify.config.errors import InputError
from densify.config.plugins.table import Row, Table


@dataclass(frozen=True)
class Output(Row):
    """owned: the files and folders in the key's folder that it alone may write."""

    owned: tuple[str, ...] = ()


def _built_in(name: str, *owned: str, module: str = "") -> Output:
    return Output(name, module or f"densify.outputs.{name}", owned=owned)


OUTPUTS = Table(
    "output",
    "densify.outputs",
    ("write_output",),
    (
        _built_in("depth", "depth", "depth_filled", "confidence", "age",
                  module="densify.outputs.depth_maps"),
        _built_in("full", "depth_full", "confidence_full", module="densify.outputs.full_maps"),
        _built_in("flow", "flow", module="densify.outputs.flow_npz"),
        _built_in("movers", "movers"),
        _built_in("tracks", "movers.json"),
        _built_in("optical_flow", "optical_flow"),
        _built_in("rejected", "rejected"),
        _built_in("cloud", "cloud.laz", module="densify.outputs.cloud_laz"),
        _built_in("scene", "scene"),
        _built_in("metrics", "metrics.json"),
        _built_in("figure", "figure.png"),
        _built_in("curve", "curve.png"),
        _built_in("run", "run.yaml", module="densify.outputs.run_yaml"),
        # Last, for it reads what the others wrote.
        _built_in("report", "report.html", module="densify.dataset.report"),
    ),
)  # fmt: skip


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
