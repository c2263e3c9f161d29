# SPDX-License-Identifier: MIT
"""Verbs and options. Imports nothing heavy, so that help answers at once."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from densify.cli import verbs
from densify.cli.bench_arguments import add_bench
from densify.cli.dataset_arguments import add_dataset
from densify.cli.options import (
    DATA_HELP,
    add_camera,
    add_config_options,
    add_method,
    add_output_options,
    add_overwrite,
    add_short_options,
    add_verb,
    add_window,
    config_epilog,
    frame_range,
    key_slice,
    natural,
    positive,
    size_bytes,
    words,
)
from densify.errors import brief
from densify.plugins.exports import EXPORTS
from densify.version import __version__


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Options of one command; ``options.verb(options)`` runs it. Exits with 2 on a bad argument."""
    parser = _Parser(
        prog="densify",
        description="Dense depth maps from lidar recordings, with the moving objects kept sharp.",
        epilog="Exit codes: 0 done, 1 the computation failed, 2 bad input, 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"densify {__version__}")
    commands = parser.add_subparsers(title="verbs", metavar="VERB", required=True)
    _add_run(commands)
    _add_compare(commands)
    add_dataset(commands)
    _add_flow(commands)
    _add_info(commands)
    _add_doctor(commands)
    _add_simulate(commands)
    _add_export(commands)
    _add_report(commands)
    _add_evaluate(commands)
    add_bench(commands)
    return parser.parse_args(arguments)


class _Parser(argparse.ArgumentParser):
    """Complains in one line and takes no abbreviated options, which would break with new ones."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, allow_abbrev=False)

    def _print_message(self, message: str, file: Any = None) -> None:
        """As argparse has it, but where it cannot be written that is said."""
        if message:
            print(message, end="", file=file or sys.stderr)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"densify: {brief(message)}; see {self.prog} --help\n")


def _add_run(commands: Any) -> None:
    parser = add_verb(commands, "run", verbs.run, "densify one key or several", config_epilog())
    parser.add_argument(
        "--key",
        type=natural,
        action="append",
        default=[],
        metavar="K",
        help="the frame to densify; may be given several times",
    )
    parser.add_argument(
        "--keys",
        type=key_slice,
        metavar="A:B[:S]",
        help="frames A to B-1, every S-th, of those that exist; keys whose windows overlap share "
        "registration and motion",
    )
    _add_key_options(parser)
    add_method(parser)
    parser.add_argument(
        "--prior",
        type=Path,
        metavar="DIR",
        help="depth images of your own, as of a monocular network: DIR/CAMERA/FRAME.npy, .exr or "
        ".png (16 bit), of any scale, depth or inverse depth; fitted to what is measured they make "
        "depth_full/, where nothing is measured or filled; masks in DIR/sky/CAMERA/FRAME.png",
    )
    parser.add_argument(
        "--film",
        type=Path,
        metavar="FILE",
        help="of one key: a film of 8 s, .webp (half a megabyte), .gif or .mp4: registration alone "
        "turns into ours, then sweep by sweep",
    )
    add_output_options(parser)


def _add_compare(commands: Any) -> None:
    about = "methods side by side, on the same registration"
    parser = add_verb(commands, "compare", verbs.compare, about, config_epilog())
    parser.add_argument(
        "--key", type=natural, required=True, metavar="K", help="the frame to densify"
    )
    _add_key_options(parser)
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


def _add_flow(commands: Any) -> None:
    about = "scene flow of a recording, or between two point files in one coordinate frame"
    parser = add_verb(
        commands,
        "flow",
        verbs.flow,
        about,
        "Point files: .npy (N,3 or more columns), .npz (array 'points'), .txt and .csv (columns), "
        ".bin (KITTI: float32 x y z reflectance), .pcd, .ply, .las, .laz. Where both are .npz and "
        "hold when each point was measured ('offset_ns', or 'time' in seconds) or by which "
        "scanner ('lidar'), that is used. "
        "The result holds 'residual_flow' (N,3) float32 metres, "
        "'moving' (N,) bool, 'instance' (N,) int32 (-1 none) and 'lost' (N,) bool, row by row as "
        "SOURCE. Of a recording, the flow of each sweep to the next is written: npz: "
        "DIR/FRAME_NEXT.npz, flow files as --flow npz:DIR reads them; av2: DIR/NAME/STAMP.feather, "
        "the files of the Argoverse 2 scene flow challenge (all points, without the ego-motion); "
        "opensceneflow: DIR/NAME.h5, all sweeps with their flow.",
    )
    for name, when in (("source", "first"), ("target", "second")):
        parser.add_argument(
            name, metavar=name.upper(), type=Path, nargs="?", help=f"points at the {when} time"
        )
    parser.add_argument("--data", metavar="SPEC", help=f"instead: {DATA_HELP.partition(' (')[0]}")
    parser.add_argument("--all", action="store_true", help="every sweep of it")
    parser.add_argument(
        "--keys", type=key_slice, metavar="A:B[:S]", help="sweeps A to B-1, every S-th"
    )
    parser.add_argument(
        "--format",
        choices=("npz", "av2", "opensceneflow"),
        help="of what is written (default: npz)",
    )
    add_config_options(parser)
    parser.add_argument(
        "--out",
        metavar="F.npz|DIR",
        type=Path,
        help="(default: ./densify-out/flow.npz, of a recording ./densify-out)",
    )
    add_overwrite(parser)


def _add_info(commands: Any) -> None:
    parser = add_verb(
        commands, "info", verbs.info, "what a recording holds: frames, rate, cameras, stamps, poses"
    )
    parser.add_argument("--data", metavar="SPEC", default="street", help=DATA_HELP)


def _add_doctor(commands: Any) -> None:
    parser = add_verb(
        commands,
        "doctor",
        verbs.doctor,
        "what may be wrong with a recording, and what mends it",
        "Looks at fifteen sweeps and a few images from all over the recording. Each check has a "
        "verdict (fine, unknown, suspicious, wrong), the number it rests on, and the option or "
        "line that mends it. Exit code 2 if something is wrong.",
    )
    parser.add_argument(
        "data", metavar="SPEC", nargs="?", default="street", help=f"the recording: {DATA_HELP}"
    )
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")
    parser.add_argument(
        "--write-config",
        action="store_true",
        help="instead: draft the densify.yaml of a folder of sweeps from what is found in it",
    )
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="FILE.png",
        help="draw neighbouring sweeps upon each other, depth over the image, and depth edges over "
        "image edges",
    )
    add_config_options(parser)
    add_overwrite(parser)


def _add_simulate(commands: Any) -> None:
    about = "write the built-in street in a data set's format with exact ground truth"
    parser = add_verb(commands, "simulate", verbs.simulate, about)
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder to make")
    parser.add_argument(
        "--format",
        default="kitti",
        metavar="NAME",
        help="the format to write: kitti (default), folder, ros1, ros2, argoverse2, "
        "kitti-odometry, kitti-tracking, kitti-360, nuscenes, opensceneflow, waymo, dgp, pandaset",
    )
    parser.add_argument(
        "--preset",
        default="street",
        metavar="NAME",
        help="street, static, crossing or highway (default: street)",
    )
    parser.add_argument(
        "--sensor",
        metavar="NAME",
        help="the scanner: hdl64, hdl32, vlp16, os128, vls128, dual32, panda, pandaset, "
        "rosette (default: hdl64)",
    )
    parser.add_argument(
        "--hz",
        choices=("5", "10", "20"),
        help="sweeps per second (default: 10); at 20 Hz a scanner "
        "measures half the columns in a sweep, at 5 Hz twice as many",
    )
    parser.add_argument(
        "--tilt", metavar="DEG", help="pitch of the scanner's mount, nose down (default: 0)"
    )
    parser.add_argument("--seed", type=natural, metavar="N", help="another seed, another street")
    parser.add_argument(
        "--frames", type=frame_range, metavar="A:B", help="frames A to B-1 only (default: all)"
    )
    add_camera(parser)
    add_overwrite(parser)


def _add_export(commands: Any) -> None:
    parser = add_verb(
        commands,
        "export",
        verbs.export,
        "a finished run in other tools' formats, or with only the certain and fresh pixels",
        "Nothing is computed again and the run stays as it is. A filled pixel has the age of the "
        "measured pixel nearest to it. FORMAT is "
        + "; ".join(f"{form.name}: {form.about}" for form in EXPORTS.built_in)
        + ".",
    )
    parser.add_argument(
        "run", metavar="RUN", type=Path, help="folder of one key, such as densify-out/000120"
    )
    parser.add_argument("--to", metavar="FORMAT", default="png", help="(default: png)")
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
    parser.add_argument(
        "--out", metavar="DIR", type=Path, help="(default: RUN/export, RUN/export/FORMAT)"
    )
    add_camera(parser)
    add_overwrite(parser)


def _add_report(commands: Any) -> None:
    parser = add_verb(
        commands,
        "report",
        verbs.report,
        "one self-contained page to look at a run, a comparison or a training set in a browser",
        "Of a key: the image with every map, depth under the pointer, what a least confidence "
        "leaves, the cloud in 3-D, scores and costs, in one HTML file of 12 MB at most that needs "
        "no network. "
        "Files that are missing or damaged are named on it. Of a training set, or of a folder of "
        "several runs: every key with a picture and its scores, what was put aside and why.",
    )
    parser.add_argument(
        "place",
        metavar="DIR",
        type=Path,
        help="folder of one key, such as densify-out/000120, one of several, or a training set",
    )
    parser.add_argument(
        "--out",
        metavar="FILE.html",
        type=Path,
        help="(default: DIR/report.html, and compare.html of a comparison)",
    )
    add_overwrite(parser)


def _add_evaluate(commands: Any) -> None:
    parser = add_verb(
        commands,
        "evaluate",
        verbs.evaluate,
        "scores of depth maps against true ones, as KITTI's depth benchmark defines them",
        "PREDICTED and TRUTH: a depth PNG (KITTI's format) each, or folders, of which every PNG "
        "is paired by drive, camera and frame: KITTI depth trees "
        "(DRIVE/proj_depth/groundtruth/image_02/0000000005.png), densify's output "
        "(000005/depth/image_02.png), sets of densify dataset, or plain folders of equal names. A "
        "pixel that PREDICTED lacks costs coverage and is no error. Numbers are means over images.",
    )
    parser.add_argument("predicted", metavar="PREDICTED", type=Path, help="a PNG or a folder")
    parser.add_argument("truth", metavar="TRUTH", type=Path, help="a PNG or a folder")
    parser.add_argument(
        "--mask",
        type=Path,
        metavar="PNG|DIR",
        help="what moves, not 0 in an image or a folder of them: scores of moving and static "
        "pixels too",
    )
    parser.add_argument(
        "--filled",
        action="store_true",
        help="of what densify made, score depth_filled (of a set, groundtruth_filled)",
    )
    parser.add_argument(
        "--focal-px",
        type=positive,
        metavar="F",
        help="the camera's fx, for outliers and edges (default: KITTI's, 721.5377)",
    )
    parser.add_argument(
        "--baseline-m",
        type=positive,
        metavar="B",
        help="stereo baseline that outliers are told by (default: KITTI's, 0.54)",
    )
    parser.add_argument("--out", metavar="FILE.json", type=Path, help="write every number there")
    add_overwrite(parser)


def _add_key_options(parser: argparse.ArgumentParser) -> None:
    add_window(parser)
    parser.add_argument(
        "--cache",
        action="store_true",
        help="keep poses, ground, evidence and motion on disk, and take what an earlier run with "
        "the same sweeps and settings left there (default: nothing is kept, since hashing and "
        "writing cost more than a single run gains)",
    )
    parser.add_argument(
        "--cache-size",
        type=size_bytes,
        default="10G",
        metavar="SIZE",
        help="bound of what --cache keeps (default: 10G)",
    )
    parser.add_argument("--data", metavar="SPEC", default="street", help=DATA_HELP)
    add_camera(parser)
    add_short_options(parser)
    add_config_options(parser)
