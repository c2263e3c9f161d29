# SPDX-License-Identifier: MIT
"""Answer the verbs of finished runs: ``densify export``, ``report`` and ``view``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.options import add_common, add_verb, option
from densify.cli.screen import Answer
from densify.config.plugins import EXPORTS

_ONE = "folder of a key, such as densify-out/street/000120"


def add_export(commands: Any) -> None:
    """Add the options of ``export``."""
    parser = add_verb(
        commands,
        "export",
        answer_export,
        "write a finished run in the formats of other tools",
        "Nothing is computed again, and the run does not change. A filled pixel has the age of the "
        "nearest measured pixel.",
    )
    about = f"{_ONE}, or of several keys (all forms but npy, exr, ply, pcd)"
    parser.add_argument("run", metavar="RUN", type=Path, help=about)
    about = f"{', '.join(EXPORTS)}: see docs/formats/writing.md"
    option(parser, "--to FORMAT", about, required=True)
    about = "leave out pixels and points of lower confidence, 0 to 1 (default: 0, keep all)"
    option(parser, "--min-confidence C", about, type=float, default=0.0)
    about = "leave out what was measured longer before or after the exposure (default: keep all)"
    option(parser, "--max-age-ms MS", about, type=float)
    option(parser, "--out DIR", "folder to write into (default: RUN/export/FORMAT)", type=Path)
    add_common(parser, "camera", "overwrite")


def answer_export(options: argparse.Namespace) -> Iterator[Answer]:
    """Export the run."""
    from densify.cli.results import export_summary
    from densify.outputs.export import export_run, facts

    exported = export_run(
        options.run,
        options.to,
        options.out,
        min_confidence=options.min_confidence,
        max_age_ms=options.max_age_ms,
        cameras=options.cameras,
        overwrite=options.overwrite,
    )
    yield Answer(export_summary(exported), facts(exported), exported.paths)


def add_report(commands: Any) -> None:
    """Add the options of ``report``."""
    parser = add_verb(
        commands,
        "report",
        answer_report,
        "make a page for the browser, of a run, a comparison or a training set",
        "The page of a key shows its maps over the image, the depth under the pointer, the cloud "
        "in 3-D, scores and costs. It is one HTML file that needs no network. It names files that "
        "are missing or damaged. The page of a training set is a table of its keys. The file is "
        "DIR/report.html, or DIR/compare.html for a comparison.",
    )
    about = f"{_ONE}, of several keys, or of a training set"
    parser.add_argument("place", metavar="DIR", type=Path, help=about)
    add_common(parser, "overwrite")


def answer_report(options: argparse.Namespace) -> Iterator[Answer]:
    """Write the page of a folder."""
    from densify.dataset.report import write_report

    yield Answer(files=write_report(options.place, options.overwrite))


def add_view(commands: Any) -> None:
    """Add the options of ``view``."""
    parser = add_verb(
        commands,
        "view",
        answer_view,
        "show a finished run in rerun or open3d",
        "Needs a screen, and the extra rerun or open3d (pip install 'densify-lidar[rerun]'). "
        "densify report needs only a browser.",
    )
    about = f"{_ONE}, or of several keys of a drive"
    parser.add_argument("place", metavar="DIR", type=Path, help=about)
    about = "the viewer: rerun (default), with sweeps over time, or open3d"
    option(parser, "--with VIEWER", about, choices=("rerun", "open3d"), default="rerun", dest="by")
    add_common(parser, "camera")


def answer_view(options: argparse.Namespace) -> Iterator[Answer]:
    """Show finished runs in a viewer."""
    from densify.outputs.finished_run import Thresholds, finished_runs
    from densify.outputs.viewers import show_in_open3d, show_in_rerun

    runs = finished_runs(options.place, Thresholds(cameras=options.cameras))
    (show_in_rerun if options.by == "rerun" else show_in_open3d)(runs)
    keys = [run.key for run in runs]
    yield Answer(f"shown: key {', '.join(map(str, keys))}", {"keys": keys})
