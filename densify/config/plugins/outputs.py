# SPDX-License-Identifier: MIT
"""The outputs: each writes some of the files of one densified key.

To add one, write a module with the function that `densify.outputs.store.OutputModule` describes and
one row here. In a package of your own an entry point in the group ``densify.outputs`` takes the
row's place, and ``OWNED`` of the module says what the row's ``owned`` says; it is written where
``output.also`` names it.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

from densify.config.errors import InputError
from densify.config.plugins.table import Table


@dataclass(frozen=True)
class Output:
    """owned: the files and folders in the key's folder that it may write, nobody else's."""

    name: str
    module: str
    owned: tuple[str, ...]

    @property
    def usage(self) -> str:
        """How ``output.also`` names it."""
        return self.name


def _row(name: str, module: ModuleType, version: str) -> Output:
    return Output(name, module.__name__, tuple(getattr(module, "OWNED", ())))


OUTPUTS = Table(
    kind="output",
    group="densify.outputs",
    built_in=(
        Output(
            "depth",
            "densify.outputs.depth_maps",
            owned=("depth", "depth_filled", "confidence", "age"),
        ),
        Output("full", "densify.outputs.full_maps", owned=("depth_full", "confidence_full")),
        Output("flow", "densify.outputs.flow_npz", owned=("flow",)),
        Output("movers", "densify.outputs.movers", owned=("movers",)),
        Output("tracks", "densify.outputs.tracks", owned=("movers.json",)),
        Output("optical_flow", "densify.outputs.optical_flow", owned=("optical_flow",)),
        Output("rejected", "densify.outputs.rejected", owned=("rejected",)),
        Output("cloud", "densify.outputs.cloud_laz", owned=("cloud.laz",)),
        Output("scene", "densify.outputs.scene", owned=("scene",)),
        Output("metrics", "densify.outputs.metrics", owned=("metrics.json",)),
        Output("figure", "densify.outputs.figure", owned=("figure.png",)),
        Output("curve", "densify.outputs.curve", owned=("curve.png",)),
        Output("run", "densify.outputs.run_yaml", owned=("run.yaml",)),
        # Last, for it reads what the others wrote.
        Output("report", "densify.dataset.report", owned=("report.html",)),
    ),
    members=("write_output",),
    row_of=_row,
)


def check_also(also: str) -> None:
    """Raise InputError unless ``also`` names outputs, parted by commas. Imports none."""
    for name in _names(also):
        OUTPUTS.require(name, "output.also")


def chosen(also: str) -> list[Output]:
    """The built-in outputs, then those that ``also`` names; imports these.

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
            if both := sorted(set(row.owned) & set(other.owned)):
                raise InputError(
                    f"output.also: {name} would write {', '.join(both)} of the output "
                    f"{other.name}; leave one of them out"
                )
        rows.append(row)
    return rows


def _names(also: str) -> list[str]:
    return [word.strip() for word in also.split(",") if word.strip()]
