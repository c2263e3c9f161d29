# SPDX-License-Identifier: MIT
"""What each verb does: open, call the Python API, write, and print results and paths."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import densify
from densify.cli.screen import keys_on_stderr, print_paths, progress_on_stderr, tell_doubts
from densify.config import as_mapping, resolve
from densify.errors import ComputationError, InputError

if TYPE_CHECKING:
    from densify.cache import Cache
    from densify.types import LidarSequence


def run(options: argparse.Namespace) -> None:
    """Densify one key or several."""
    config = _config(options)
    from densify import pipeline
    from densify.cli.tables import summary
    from densify.memory import check_fits
    from densify.outputs import check_writable, write_result
    from densify.readers import open_sequence

    sequence = open_sequence(options.data)
    keys = _keys_of(sequence, options)
    for key in keys:
        check_writable(options.out, key, options.overwrite, "run", config.output.also)
    if options.film is not None:
        from densify.report.film import check_film, write_film

        if len(keys) > 1:
            raise InputError(f"--film {options.film}: got {len(keys)} keys, expected one")
        check_film(options.film, options.overwrite)
    failed: dict[int, Exception] = {}
    doubts: list[tuple[str, str, int]] = []
    with progress_on_stderr() as progress:
        made = pipeline.run_keys(
            sequence,
            keys,
            options.window,
            options.method,
            options.cameras,
            config,
            progress,
            _cache(options),
            options.prior,
        )
        check_fits(sequence, keys[0], options.window, options.cameras, config)
        for key, result in made:
            if isinstance(result, Exception):
                failed[key] = result
                continue
            paths = write_result(
                result,
                result.images,
                options.out,
                config=as_mapping(config),
                data=options.data,
                overwrite=options.overwrite,
                also=config.output.also,
            )
            if options.film is not None:
                write_film(options.out / f"{key:06d}", options.film, overwrite=True)
                paths.append(options.film)
            print(summary(result))
            print_paths(paths)
            doubts += [(warning, "", key) for warning in result.warnings]
    tell_doubts(doubts)
    if len(keys) == 1 and failed:
        raise failed[keys[0]]
    if failed:
        told = "; ".join(f"key {key}: {error}" for key, error in failed.items())
        raise ComputationError(f"{len(failed)} of {len(keys)} keys not made: {told}")


def compare(options: argparse.Namespace) -> None:
    """Methods side by side."""
    config = _config(options)
    from densify import pipeline
    from densify.cli.tables import comparison
    from densify.memory import check_fits
    from densify.methods import COMPARED
    from densify.outputs import check_writable, write_comparison
    from densify.readers import open_sequence

    check_writable(options.out, options.key, options.overwrite, "compare")
    sequence = open_sequence(options.data)
    check_fits(sequence, options.key, options.window, options.cameras, config)
    with progress_on_stderr() as progress:
        results = pipeline.compare(
            sequence,
            options.key,
            options.window,
            options.cameras,
            config,
            progress,
            options.methods or COMPARED,
            _cache(options),
        )
    paths = write_comparison(
        results,
        next(iter(results.values())).images,
        options.out,
        config=as_mapping(config),
        data=options.data,
        overwrite=options.overwrite,
    )
    if config.output.report:
        from densify.report import write_comparison_page

        paths.append(write_comparison_page(paths[0].parent))
    print(comparison(results))
    print_paths(paths)
    told = dict.fromkeys(w for r in results.values() for w in r.warnings)
    tell_doubts((warning, "", options.key) for warning in told)


def dataset(options: argparse.Namespace) -> None:
    """Every key of whole recordings, or how far that is."""
    from densify.cli.sets import set_status, set_summary

    if options.status is not None:
        from densify.dataset.make import damaged, status

        print(set_status(*status(options.status)))
        files = damaged(options.status) if options.verify else []
        for name in files:
            print(f"damaged: {name}")
        if files:
            raise ComputationError(
                f"--verify: {len(files)} damaged or missing files in {options.status}; run the "
                f"command that made the set again with --verify, which makes them anew"
            )
        return
    if options.out is None:
        raise InputError("--out DIR: expected the set's folder, a new one or one to go on with")
    config = _config(options)
    from densify.dataset.gate import Gate
    from densify.dataset.make import make_dataset
    from densify.dataset.plan import Recipe

    limits = ("max_ghost", "min_density", "max_outliers", "min_sweeps")
    recipe = Recipe(
        window=options.window,
        method=options.method,
        layout=options.layout,
        cameras=None if options.cameras is None else tuple(options.cameras),
        split=options.split,
        gate=Gate(**{limit: getattr(options, limit) for limit in limits}),
        config=config,
    )
    with keys_on_stderr() as report:
        summary = make_dataset(
            options.data or ["street"],
            options.out,
            options.keys,
            recipe,
            num_workers=options.workers,
            scheduler=options.scheduler,
            shard=options.shard,
            memory_bytes=options.memory,
            cache_bytes=options.cache_size,
            verify=options.verify,
            links=options.links,
            report=report,
        )
    print(set_summary(summary))
    print_paths([options.out])
    tell_doubts((w, r.drive, r.key) for r in summary.records.values() for w in r.warnings)
    if summary.count("failed"):
        raise ComputationError(f"{summary.count('failed')} of {summary.num_keys} keys not made")


def flow(options: argparse.Namespace) -> None:
    """Scene flow between two point files, or of a recording."""
    config = resolve(options.config, options.overrides)
    if options.data is not None:
        return _flow_of_recording(options, config)
    from densify.cli.point_files import check_new_file, read_points, write_flow

    if options.target is None or options.keys is not None or options.all or options.format:
        raise InputError(
            "densify flow: expected SOURCE and TARGET, two point files, or --data SPEC with --all "
            "or --keys A:B[:S]; see densify flow --help"
        )
    options.out = options.out or Path("densify-out/flow.npz")
    check_new_file(options.out, options.overwrite)
    source, target = read_points(options.source), read_points(options.target)
    columns = {
        f"{side}_{name}": getattr(file, name)
        for name in ("offset_ns", "lidar")
        if getattr(source, name) is not None and getattr(target, name) is not None
        for side, file in (("source", source), ("target", target))
    }
    field = densify.estimate_flow(source.points, target.points, config, **columns)
    write_flow(options.out, field)
    num_moving = int(field.moving.sum())
    print(f"{len(source.points):,} points, {num_moving:,} moving")
    print_paths([options.out])


def _flow_of_recording(options: argparse.Namespace, config: densify.Config) -> None:
    from densify.outputs.flow_sets import flow_writer
    from densify.pipeline import flow_steps
    from densify.readers import open_sequence

    if options.source is not None or options.all == (options.keys is not None):
        raise InputError(
            "densify flow --data SPEC: expected either --all or --keys A:B[:S], and no point files"
        )
    sequence, out = open_sequence(options.data), options.out or Path("densify-out")
    frames = list(sequence.frames)
    if options.keys is not None:
        frames = _sliced(sequence, options.keys)
    paths: dict[Path, None] = {}
    failed: dict[int, Exception] = {}
    num_moving = 0
    with (
        progress_on_stderr() as progress,
        flow_writer(options.format or "npz", sequence, out, frames, options.overwrite) as write,
    ):
        for frame, flow in flow_steps(sequence, frames, config, progress):
            if isinstance(flow, Exception):
                failed[frame] = flow
                continue
            paths[write(frame, flow)] = None
            num_moving += sum(int(field.moving.sum()) for field in flow.steps.values())
    print(f"{len(frames) - len(failed):,} sweeps, {num_moving:,} points moving")
    print_paths(list(dict.fromkeys(path.parent for path in paths)))
    if failed:
        told = "; ".join(f"sweep {frame}: {error}" for frame, error in failed.items())
        raise ComputationError(f"{len(failed)} of {len(frames)} sweeps not made: {told}")


def info(options: argparse.Namespace) -> None:
    """What a recording holds."""
    from densify.readers import open_sequence
    from densify.readers.describe import describe

    print(describe(open_sequence(options.data)))


def doctor(options: argparse.Namespace) -> None:
    """What may be wrong with a recording."""
    config = resolve(options.config, options.overrides)
    from densify.cli.findings import diagnosis_json, diagnosis_table
    from densify.cli.point_files import check_new_file
    from densify.doctor import Verdict, examine
    from densify.readers import open_sequence
    from densify.readers.describe import describe

    if options.write_config:
        return _write_folder_config(Path(options.data), options.overwrite)
    if options.picture is not None:
        check_new_file(options.picture, options.overwrite, ".png")
    sequence = open_sequence(options.data)
    diagnosis = examine(sequence, config, Path())
    if options.json:
        print(diagnosis_json(diagnosis))
    else:
        print(describe(sequence), diagnosis_table(diagnosis), sep="\n\n")
    if options.picture is not None:
        from densify.doctor.picture import draw
        from densify.outputs.png import write_picture

        write_picture(options.picture, draw(diagnosis.sample))
        if not options.json:
            print_paths([options.picture])
    wrong = [f.check for f in diagnosis.findings if f.verdict == Verdict.WRONG]
    if wrong:
        raise InputError(f"{options.data}: wrong: {', '.join(wrong)}; the remedies are above")


def _write_folder_config(folder: Path, overwrite: bool) -> None:
    from densify.outputs.atomic import write_file
    from densify.readers.folder.draft import draft_config

    path = folder / "densify.yaml"
    if path.exists() and not overwrite:
        raise InputError(f"{path}: there already, kept; give --overwrite to replace it")
    write_file(path, draft_config(folder).encode())
    print_paths([path])


def simulate(options: argparse.Namespace) -> None:
    """The built-in street in a data set's format, with truth."""
    from densify.readers.street import Street
    from densify.writers import write_street

    street = Street.from_spec(_street_spec(options))
    frames = _frames_of(street, options.frames)
    cameras = _cameras_of(street, options.cameras)
    with progress_on_stderr() as progress:
        place = write_street(
            options.format,
            street,
            options.out,
            frames,
            cameras,
            progress,
            overwrite=options.overwrite,
        )
    print(f"{len(frames)} frames; open them with --data {place}")


def export(options: argparse.Namespace) -> None:
    """A finished run in another form, or with fewer pixels."""
    from densify.cli.tables import export_summary
    from densify.outputs import export_run

    exported = export_run(
        options.run,
        options.min_confidence,
        options.max_age_ms,
        options.out,
        options.overwrite,
        options.to,
        options.cameras,
    )
    if said := export_summary(exported):
        print(said)
    print_paths(exported.paths)


def report(options: argparse.Namespace) -> None:
    """A page of what is in a folder."""
    from densify.report import write_report

    with progress_on_stderr() as progress:
        paths = write_report(options.place, options.out, options.overwrite, progress)
    print_paths(paths)


def evaluate(options: argparse.Namespace) -> None:
    """Depth maps against the truth."""
    from densify.bench import evaluation
    from densify.bench.table_file import write_table
    from densify.cli.point_files import check_new_file
    from densify.cli.tables import evaluation_table
    from densify.readers.depth_trees import pair_depth_files

    if options.out is not None:
        check_new_file(options.out, options.overwrite, ".json")
    pairs = pair_depth_files(options.predicted, options.truth, options.mask, filled=options.filled)
    given = {name: getattr(options, name) for name in ("focal_px", "baseline_m")}
    stereo = {name: value for name, value in given.items() if value is not None}
    with progress_on_stderr() as progress:
        scores = evaluation.evaluate(pairs, **stereo, progress=progress)
    print(evaluation_table(scores))
    if options.out is not None:
        write_table(options.out, scores)
        print_paths([options.out])


_SHORT = {
    "flow": "flow.engine",
    "at": "project.at",
    "movers": "output.movers",
    "per": "project.per",
}


def _config(options: argparse.Namespace) -> densify.Config:
    given = {knob: getattr(options, name) for name, knob in _SHORT.items()}
    named = [f"{knob}={value}" for knob, value in given.items() if value is not None]
    if options.report:
        named += ["output.report=true", "output.rejected=true"]
    return resolve(options.config, [*options.overrides, *named])


def _keys_of(sequence: LidarSequence, options: argparse.Namespace) -> list[int]:
    """``--key`` and ``--keys`` together, ascending."""
    from densify.readers.files import format_frames

    frames = frozenset(sequence.frames)
    wanted = {*options.key}
    if options.keys is not None:
        wanted |= {*_sliced(sequence, options.keys)}
    for key in sorted(wanted - frames):
        raise InputError(
            f"--key {key}: no such frame in {sequence.name}; "
            f"it has {format_frames(sequence.frames)}"
        )
    if not wanted:
        raise InputError(
            "--key K or --keys A:B[:S]: expected the frame or frames to densify; "
            "see densify run --help"
        )
    return sorted(wanted)


def _sliced(sequence: LidarSequence, keys: slice) -> list[int]:
    from densify.readers.files import format_frames

    chosen = frozenset(range(keys.start, keys.stop, keys.step or 1))
    there = [frame for frame in sequence.frames if frame in chosen]
    if not there:
        raise InputError(
            f"--keys {keys.start}:{keys.stop}: {sequence.name} has no sweep among them; it has "
            f"{format_frames(sequence.frames)}"
        )
    return there


def _cache(options: argparse.Namespace) -> Cache | None:
    if not options.cache:
        return None
    from densify.cache import Cache

    return Cache(options.cache_size)


def _street_spec(options: argparse.Namespace) -> str:
    preset = options.preset.removeprefix("street:")
    name = "street" if preset == "street" else f"street:{preset}"
    keys = ("seed", "sensor", "hz", "tilt")
    query = [f"{k}={v}" for k in keys if (v := getattr(options, k)) is not None]
    return f"{name}?{'&'.join(query)}" if query else name


def _frames_of(street: LidarSequence, wanted: range | None) -> list[int]:
    frames = list(street.frames)
    if wanted is None:
        return frames
    if wanted[0] < frames[0] or wanted[-1] > frames[-1]:
        raise InputError(
            f"--frames {wanted.start}:{wanted.stop}: expected frames within "
            f"{frames[0]}:{frames[-1] + 1}"
        )
    return list(wanted)


def _cameras_of(street: LidarSequence, wanted: list[str] | None) -> list[str]:
    for name in wanted or ():
        if name not in street.cameras:
            raise InputError(f"--camera {name}: expected one of {', '.join(street.cameras)}")
    return list(street.cameras) if wanted is None else wanted
