# SPDX-License-Identifier: MIT
"""``densify export``: a finished run for other tools."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from densify.cli.answer import Answer
from densify.cli.options import add_camera, add_overwrite, add_verb
from densify.config.plugins.exports import EXPORTS


def add(commands: Any) -> None:
    """Add its options."""
    parser = add_verb(
        commands,
        "export",
        answer,
        "a finished run in other tools' formats, optionally with only the certain, recent pixels",
        "Nothing is computed again and the run stays as it is. A filled pixel has the age of the "
        "measured pixel nearest to it. FORMAT is "
        + "; ".join(f"{form.name}: {form.about}" for form in EXPORTS.built_in)
        + ".",
    )
    parser.add_argument(
        "run", metavar="RUN", type=Path, help="folder of one key, such as densify-out/000120"
    )
    parser.add_argument("--to", metavar="FORMAT", required=True, help="see above")
    parser.add_argument(
        "--min-confidence",
        type=float,
        default=0.0,
        metavar="C",
        help="drop pixels and points less certain, 0 to 1 (default: 0, keep all)",
    )
    parser.add_argument(
        "--max-age-ms",
        type=float,
        metavar="MS",
        help="drop pixels and points measured longer before or after (default: keep all)",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help="(default: RUN/export/FORMAT)")
    add_camera(parser)
    add_overwrite(parser)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
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
