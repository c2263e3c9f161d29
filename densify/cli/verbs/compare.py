# SPDX-License-Identifier: MIT
"""``densify compare``: methods side by side."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from densify.cli.answer import Answer, first_of
from densify.cli.options import (
    add_key_options,
    add_output_options,
    add_verb,
    cache_of,
    config_epilog,
    config_of,
    natural,
    words,
)
from densify.cli.progress import Course, course_on_stderr
from densify.cli.screen import tell_doubts
from densify.config import as_mapping


def add(commands: Any) -> None:
    """Its options."""
    about = "methods side by side, on the same registration"
    parser = add_verb(commands, "compare", answer, about, config_epilog())
    parser.add_argument(
        "--key", type=natural, required=True, metavar="K", help="the frame to densify"
    )
    add_key_options(parser)
    parser.add_argument(
        "--methods",
        type=words,
        metavar="NAME,…",
        help="of none (the key sweep), icp (registration only), icp-far (the same of all sweeps "
        "within accumulate.far_m), "
        "icp-visible (registration with our visibility), "
        "flow-plain (our scene flow without it), paper (the published scene flow), flow (ours); "
        "default: none,icp,icp-far,paper,flow",
    )
    add_output_options(parser)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Methods side by side."""
    config = config_of(options)
    from densify.cli.results import FIRST_OF_COMPARISON, comparison, key_facts
    from densify.outputs import check_writable, write_comparison
    from densify.pipeline import run as pipeline
    from densify.pipeline.memory import check_fits
    from densify.pipeline.methods import COMPARED, engines
    from densify.readers import open_sequence

    check_writable(options.out, options.key, options.overwrite, "compare")
    sequence = open_sequence(options.data)
    check_fits(sequence, options.key, options.window, options.cameras, config)
    methods = options.methods or COMPARED
    course = Course(engines(methods, config.flow.engine))
    with course_on_stderr(course):
        results = pipeline.compare(
            sequence,
            options.key,
            options.window,
            options.cameras,
            config,
            course.step,
            methods,
            cache_of(options),
        )
        course.step("write", 0, 1)
        paths = write_comparison(
            results,
            next(iter(results.values())).images,
            options.out,
            config=as_mapping(config),
            data=options.data,
            overwrite=options.overwrite,
        )
        if config.output.report:
            from densify.dataset.report import write_comparison_page

            paths.append(write_comparison_page(paths[0].parent))
    facts = {"key": options.key, "methods": {n: key_facts(r) for n, r in results.items()}}
    yield Answer(comparison(results), facts, paths, first_of(paths, FIRST_OF_COMPARISON))
    told = dict.fromkeys(w for r in results.values() for w in r.warnings)
    tell_doubts((warning, "", options.key) for warning in told)
