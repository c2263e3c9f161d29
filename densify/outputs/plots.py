# SPDX-License-Identifier: MIT
"""Plots: curve.png, outliers over density; the loss of a training; scene flow from above."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.geometry.types import Float, Result
from densify.outputs.atomic import write_file
from densify.outputs.context import Context

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Curve = Sequence[Mapping[str, Any]]
"""`densify.scores.depth_metrics.precision_density`."""

DPI = 100
_FEWEST_OUTLIERS = 1e-4  # below, the scale is linear down to 0
_MEDIAN_SHARE = 20  # the running median covers one part in so many of all steps


def write_plot(path: Path, figure: Figure) -> None:
    """Write a figure of matplotlib as PNG. The same figure gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    write_file(path, buffer.getvalue())


def write_curve(result: Result, context: Context, folder: Path) -> None:
    """Write ``curve.png`` of all cameras, if any method was scored with the key held out."""
    curves: dict[str, dict[str, Curve]] = {}
    for method, of_method in {**result.baselines, result.method: result}.items():
        for camera, scores in (of_method.metrics.get("held_out") or {}).items():
            curves.setdefault(camera, {})[method] = scores["curve"]
    if curves:
        write_plot(folder / "curve.png", draw_curves(curves))


def draw_curves(curves: Mapping[str, Mapping[str, Curve]]) -> Figure:
    """Draw the fraction of outliers over the density, for each least confidence.

    curves: camera -> method -> curve. Each camera has its own axes, two in a row. A thin line is of
        measured pixels, a thick line of filled pixels too.
    """
    figure, panels = _figure(len(curves), 8.6, 4.8)
    for axes, (camera, methods) in zip(panels, curves.items(), strict=True):
        for number, (method, curve) in enumerate(methods.items()):
            for kind, width in (("measured", 1.0), ("filled", 2.5)):
                known = [p for p in curve if p[f"outliers_{kind}"] is not None]
                density = [100 * p[f"density_{kind}"] for p in known]
                outliers = [100 * p[f"outliers_{kind}"] for p in known]
                label = f"{method}, {kind}"
                if known:
                    label += f": {density[0]:.1f} % of pixels, {outliers[0]:.2f} % outliers"
                line = axes.plot(density, outliers, "o-", color=f"C{number}", label=label)[0]
                line.set(linewidth=width, markersize=1 + 2 * width)
        axes.set(title=f"{camera}, key held out", xlabel="pixels with a depth, %")
        axes.set_ylabel("outliers, %")
        axes.set_yscale("symlog", linthresh=100 * _FEWEST_OUTLIERS)
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    return figure


def draw_losses(losses: Float, title: str) -> Figure:
    """Draw the loss of each step of a training, and its running median.

    losses: (S,) positive.
    """
    from scipy.ndimage import median_filter

    figure, (axes,) = _figure(1, 8.6, 4.2)
    axes.set(title=title, xlabel="step", ylabel="loss", yscale="log")
    if len(losses):
        size = len(losses) // _MEDIAN_SHARE | 1
        axes.plot(losses, ".", markersize=2, color="C0", alpha=0.4)
        axes.plot(median_filter(losses, size, mode="nearest"), color="C0", linewidth=2)
    axes.grid(alpha=0.3)
    return figure


def _figure(number: int, width_in: float, height_in: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with that many axes of a size, two in a row."""
    from matplotlib.figure import Figure

    columns = min(2, number)
    rows = -(-number // columns)
    size = columns * width_in, rows * height_in
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    return figure, [figure.add_subplot(rows, columns, 1 + i) for i in range(number)]
