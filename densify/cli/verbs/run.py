# SPDX-License-Identifier: MIT
"""Answer ``densify run``, for one key or several, and ``densify compare``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.options import (
    add_common,
    add_recording,
    add_verb,
    config_of,
    key_range,
    natural,
    option,
    recording_of,
    sliced,
    words,
)
from densify.cli.screen import Answer, first_of, progress_on_stderr, tell_doubts
from densify.config import as_mapping, presets
from densify.config.errors import ComputationError, InputError
from densify.config.plugins import ENGINES

if TYPE_CHECKING:
    from densify.geometry.types import LidarSequence, Result


def add_run(commands: Any) -> None:
    """Add the options of ``run``."""
    parser = add_verb(
        commands, "run", answer_run, "make dense depth maps of one key frame or several"
    )
    about = "number of the frame to densify; may be given several times"
    option(parser, "--key K", about, type=natural, action="append", default=[])
    about = "frames A to B-1, every S-th. Overlapping windows share registration and scene flow"
    option(parser, "--keys A:B[:S]", about, type=key_range)
    _add_key_options(parser)
    add_common(parser, "method")
    about = (
        "score the key from its neighbours alone, and make the maps of the single sweep and of "
        "rigid accumulation too (short for --set output.score=true; --report includes it)"
    )
    option(parser, "--score", about)
    about = (
        "your own depth images, for example of a monocular network, for pixels without a "
        "measurement: DIR/CAMERA/FRAME.npy, .exr or .png, of any scale. See docs/outputs.md"
    )
    option(parser, "--prior DIR|FILE", about, type=Path)


def add_compare(commands: Any) -> None:
    """Add the options of ``compare``."""
    about = "compare methods on one key frame: table, picture, JSON"
    parser = add_verb(commands, "compare", answer_compare, about)
    option(parser, "--key K", "number of the frame to densify", type=natural, required=True)
    _add_key_options(parser)
    about = (
        "none (single sweep), icp (rigid accumulation), icp-far (icp with sweeps beyond the "
        "window), icp-visible (icp with visibility), flow-plain (flow without visibility), paper "
        "(the published scene flow), flow (scene flow). Default: none,icp,icp-far,paper,flow"
    )
    option(parser, "--methods NAME,…", about, type=words)


def _add_key_options(parser: argparse.ArgumentParser) -> None:
    parser.epilog = f"Every setting, with its default and its effect: {presets()['default']}"
    add_recording(parser)
    add_common(parser, "window", "camera")
    engines = ", ".join(row.usage for row in ENGINES.built_in)
    option(parser, "--flow ENGINE", f"scene flow engine (default: groups): {engines}")
    about = (
        "write report.html, a page for the browser, with the reasons of rejected points. "
        "densify report makes it later, without the reasons"
    )
    option(parser, "--report", about)
    add_common(parser, "config")
    about = "folder of the results (default: ./densify-out/RECORDING, by the recording's name)"
    option(parser, "--out DIR", about, type=Path)
    add_common(parser, "overwrite")


def answer_run(options: argparse.Namespace) -> Iterator[Answer]:
    """Densify one key or several."""
    config = config_of(options)
    from densify.cli.results import FIRST_OF_RUN, key_facts, summary
    from densify.outputs.key_outputs import check_writable, write_result
    from densify.outputs.recording_folder import check_recording, default_folder
    from densify.pipeline import run as pipeline
    from densify.readers import Spec, open_sequence

    spec = Spec.parse(recording_of(options)).absolute()
    sequence = open_sequence(spec)
    keys = _keys_of(sequence, options)
    out = options.out or default_folder(sequence.name)
    check_recording(out, sequence.name, spec, keys)
    for key in keys:
        check_writable(out, key, options.overwrite)
    failed: dict[int, Exception] = {}
    doubts: list[tuple[str, str, int]] = []
    window, method, cameras = options.window, options.method, options.cameras
    with progress_on_stderr() as progress:
        made = pipeline.run_keys(
            sequence, keys, window, method, cameras, config, progress, prior=options.prior
        )
        for key, result in made:
            if isinstance(result, Exception):
                failed[key] = result
                yield Answer(facts={"keys": [{"key": key, "error": str(result)}]})
                continue
            paths = write_result(
                result, out, config=as_mapping(config), data=spec, overwrite=options.overwrite
            )
            first = first_of(_front_first(paths, result), FIRST_OF_RUN)
            yield Answer(summary(result), {"keys": [key_facts(result)]}, paths, first)
            doubts += [(warning, "", key) for warning in result.warnings]
            if result.depth and not any(maps.filled_m.any() for maps in result.depth.values()):
                failed[key] = ComputationError(
                    "every depth map is empty; are calibration and stamps right? densify doctor "
                    "looks into both"
                )
    tell_doubts(doubts)
    if len(keys) == 1 and failed:
        raise failed[keys[0]]
    if failed:
        told = "; ".join(f"key {key}: {error}" for key, error in failed.items())
        raise ComputationError(f"{len(failed)} of {len(keys)} keys not made: {told}")


def _front_first(paths: Sequence[Path], result: Result) -> list[Path]:
    from densify.outputs.plots import front_first

    names = front_first([*result.depth], result.views, result.T_key_lidar)
    front = [p for p in paths if names and p.with_suffix("").as_posix().endswith(f"/{names[0]}")]
    return [*front, *(path for path in paths if path not in front)]


def _keys_of(sequence: LidarSequence, options: argparse.Namespace) -> list[int]:
    from densify.readers.timeline import format_frames

    wanted = {*options.key}
    if options.keys is not None:
        wanted |= {*sliced(sequence, options.keys)}
    for key in sorted(wanted - {*sequence.frames}):
        there = format_frames(sequence.frames)
        raise InputError(f"--key {key}: no such frame in {sequence.name}; it has {there}")
    if not wanted:
        raise InputError(
            "--key K or --keys A:B[:S]: expected the frame or frames to densify; "
            "see densify run --help"
        )
    return sorted(wanted)


def answer_compare(options: argparse.Namespace) -> Iterator[Answer]:
    """Densify one key by several methods."""
    config = config_of(options)
    from densify.cli.results import FIRST_OF_COMPARISON, comparison, key_facts
    from densify.dataset.report import write_comparison_page
    from densify.outputs.key_outputs import check_writable, write_comparison
    from densify.outputs.recording_folder import check_recording, default_folder
    from densify.pipeline import run as pipeline
    from densify.pipeline.key_result import COMPARED
    from densify.readers import Spec, open_sequence

    spec = Spec.parse(recording_of(options)).absolute()
    methods = options.methods or COMPARED
    sequence = open_sequence(spec)
    out = options.out or default_folder(sequence.name)
    check_recording(out, sequence.name, spec, [options.key])
    check_writable(out, options.key, options.overwrite, "compare")
    with progress_on_stderr() as progress:
        results = pipeline.compare(
            sequence, options.key, options.window, options.cameras, config, progress, methods
        )
    paths = write_comparison(
        results, out, config=as_mapping(config), data=spec, overwrite=options.overwrite
    )
    if config.output.report:
        paths.append(write_comparison_page(paths[0].parent))
    facts = {"key": options.key, "methods": {n: key_facts(r) for n, r in results.items()}}
    yield Answer(comparison(results), facts, paths, first_of(paths, FIRST_OF_COMPARISON))
    told = dict.fromkeys(w for r in results.values() for w in r.warnings)
    tell_doubts((warning, "", options.key) for warning in told)
