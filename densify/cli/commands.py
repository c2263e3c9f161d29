# SPDX-License-Identifier: MIT
"""The manual of the commands, and their parser; a command's module is imported when it runs."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, NoReturn, cast

from densify.cli.terminal import add_options
from densify.config import presets
from densify.config.errors import did_you_mean, shorten_message
from densify.config.plugins import ENGINES, EXPORTS, READERS
from densify.version import __version__

if TYPE_CHECKING:
    from densify.cli.terminal import Answer

# Options of several commands
_RECORDINGS = """\
[SPEC+]  the recording: a folder or file, READER:PATH, or the built-in simulation
    street[:PRESET][?seed=N&sensor=NAME&hz=RATE&tilt=DEG] (default: street)
--data SPEC+  the recording, as an option"""
_RECORDING = _RECORDINGS.replace("[SPEC+]", "[SPEC]").replace("SPEC+", "SPEC...")
_WINDOW = """\
--window W =5  number of sweeps on each side of the key. More sweeps are denser and slower. Take
    twice as many at 20 Hz"""
_METHOD = """\
--method {flow,icp,none} =flow  flow: scene flow; icp: rigid accumulation; none: single sweep"""
_CAMERA = """\
--camera NAME...  take only this camera; may be given several times (default: all cameras)"""
_CONFIG = f"""\
--config FILE|NAME  settings: a YAML file, or a preset: {", ".join(presets())}
--set section.key=value...  change one setting; may be given several times"""
_OVERWRITE = "--overwrite  replace existing files (default: stop before them)"
_KEY_OPTIONS = f"""\
{_RECORDING}
{_WINDOW}
{_CAMERA}
--flow ENGINE  scene flow engine (default: groups): {", ".join(r.usage for r in ENGINES.built_in)}
--report  write report.html, a page for the browser, with the reasons of rejected points. densify
    report makes it later, without the reasons
{_CONFIG}
--out DIR  folder of the results (default: ./densify-out/RECORDING, by the recording's name)
{_OVERWRITE}"""
_ONE_RUN = "folder of a key, such as densify-out/street/000120"
_BENCH_KEY = "--key K...  key frame; may be given several times (default: 120)"
_READERS = "; ".join(f"{row.name}: {row.holds}" for row in READERS.built_in)
_SETTINGS_FILE = presets()["default"]

# A section of the manual: "== COMMAND (MODULE)", what it does, its options as `add_options`
# reads them, and after a blank line further help.
_USUAL = f"""
== info (recordings)
print what a recording holds: frames, rate, cameras, stamps, poses
{_RECORDING}

Readers: {_READERS}.

== doctor (recordings)
check whether a recording is read correctly, and print remedies
{_RECORDING}
{_CONFIG}
--write FILE  write the remedies that are settings to a YAML file, for densify run --config FILE
{_OVERWRITE}

Reads fifteen sweeps and some images from all over the recording. Each check prints a verdict (fine,
unknown, suspicious, wrong), its evidence, and the option or the line that mends it. The exit code
is 2 if something is wrong.

== run (runs)
make dense depth maps of one key frame or several
--key K...  number of the frame to densify; may be given several times (default: the middle frame
    of the recording)
--keys A:B[:S]  frames A to B-1, every S-th. Overlapping windows share registration and scene flow
{_KEY_OPTIONS}
{_METHOD}
--score  score the key from its neighbours alone, and make the maps of the single sweep and of
    rigid accumulation too (short for --set output.score=true; --report includes it)
--prior DIR|FILE  your own depth images, for example of a monocular network, for pixels without a
    measurement: DIR/CAMERA/FRAME.npy, .exr or .png, of any scale. See docs/outputs.md

Every setting, with its default and its effect: {_SETTINGS_FILE}

== compare (runs)
compare methods on one key frame: table, picture, JSON
--key K  number of the frame to densify (default: the middle frame of the recording)
{_KEY_OPTIONS}
--methods NAME,…  none (single sweep), icp (rigid accumulation), icp-far (icp with sweeps beyond
    the window), icp-visible (icp with visibility), flow-plain (flow without visibility), paper
    (the published scene flow), flow (scene flow). Default: none,icp,flow

Every setting, with its default and its effect: {_SETTINGS_FILE}

== dataset (recordings)
make a training set of whole recordings
{_RECORDINGS}
{_WINDOW}
{_METHOD}
{_CAMERA}
{_CONFIG}
--keys all|A:B[:S] =all  frames A to B-1, every S-th
--out DIR  folder of the set: a new one, or one to continue
--layout {{kitti-depth,densify}} =kitti-depth  the tree of KITTI's depth completion benchmark, or
    the files of densify run
--workers N  number of processes (default: one for each core, as far as the memory allows)
--scheduler ADDRESS  use the workers of a Dask scheduler; they need the same paths. tls://host:8786
    accepts holders of a certificate. tcp://host:8786 lets everybody on the network run programs
    here
--shard i/n  make the i-th of n parts, for several machines
--preview N  make N keys spread over the recordings, with the page of the set, and say how long the
    others take; the same command without it continues the set
--status DIR  say how far the set in DIR is, and make nothing
--verify  compare finished files with the hashes in the manifest. Damaged files are made again, or
    with --status listed (exit code 1)

The same command, run again, continues an interrupted set. --set takes the settings in
{_SETTINGS_FILE}. It also takes limits. A key beyond a limit is listed in the manifest and left out
of the set: dataset.max_ghost, share of ghosts; dataset.min_density, share of pixels with a measured
depth; dataset.max_outliers, share of outliers with the key held out; dataset.min_sweeps, sweeps in
the window; dataset.max_ratio, ghosts or outliers, as a multiple of those of neighbouring keys.
dataset.split is kitti, train or val.

== report (recordings)
make a page for the browser, of a run, a comparison or a training set
DIR  {_ONE_RUN}, of several keys, or of a training set
{_OVERWRITE}

The page of a key shows its maps over the image, the depth under the pointer, the cloud in 3-D,
scores and costs. It is one HTML file that needs no network. It names files that are missing or
damaged. The page of a training set has a verdict, the course of the scores, and pictures of the
worst keys. The file is DIR/report.html, or DIR/compare.html for a comparison.

== export (recordings)
write a finished run in the formats of other tools
RUN  {_ONE_RUN}, or of several keys (all forms but npy, exr, ply, pcd)
--to FORMAT  {", ".join(EXPORTS)}: see docs/formats/writing.md (required)
--min-confidence C =0  leave out pixels and points of lower confidence, 0 to 1
--max-age-ms MS  leave out what was measured longer before or after the exposure (default: keep all)
--out DIR  folder to write into (default: RUN/export/FORMAT)
{_CAMERA}
{_OVERWRITE}

Nothing is computed again, and the run does not change. A filled pixel has the age of the nearest
measured pixel.
"""
_MORE = f"""
== view (recordings)
show a finished run in rerun or open3d
DIR  {_ONE_RUN}, or of several keys of a drive
--with {{rerun,open3d}} =rerun  the viewer: rerun, with sweeps over time, or open3d
{_CAMERA}

Needs a screen, and the extra rerun or open3d (pip install '.[rerun]'). densify report needs only a
browser.

== flow (recordings)
estimate scene flow of a recording or between two point files
[SOURCE|SPEC]  earlier points, or a recording
[TARGET]  later points
--data SPEC  the recording, as an option
--all  take every sweep of the recording
--keys A:B[:S]  take sweeps A to B-1, every S-th
--format {{npz,av2,opensceneflow,semantickitti,doc-depth}}  form of a recording's flow (default:
    npz)
--out F.npz|DIR  file or folder (default: densify-out/flow.npz, densify-out/RECORDING)
{_CONFIG}
{_OVERWRITE}

Two point files in one coordinate frame (.npy, .npz, .txt, .csv, .bin, .pcd, .ply, .las, .laz) give
one .npz, with a row for each row of SOURCE: 'residual_flow' (N,3) metres, 'moving' (N,) bool,
'instance' (N,) int32 (-1 none), 'lost' (N,) bool. A recording, with --all or --keys, gives the flow
of each sweep to the next one. npz writes DIR/FRAME_NEXT.npz for --flow npz:DIR. av2 writes
DIR/NAME/STAMP.feather of the Argoverse 2 scene flow challenge. opensceneflow writes DIR/NAME.h5.
semantickitti writes DIR/sequences/NAME/predictions/FRAME.label, 251 moving and 9 static. doc-depth
writes DIR/NAME, the poses and classes that DOC-Depth renders.

== evaluate (recordings)
score depth maps against true depth, as KITTI's benchmark does
PREDICTED  a PNG or a folder
TRUTH  a PNG or a folder
--mask PNG|DIR  masks of moving objects (pixels that are not 0), for scores of moving and static
    pixels
--filled  score depth_filled instead of depth (in a training set groundtruth_filled)
--focal-px X =721.5377  focal length fx of the camera, for outliers, by default KITTI's
--baseline-m X =0.54  stereo baseline that defines outliers, by default KITTI's

PREDICTED and TRUTH are depth PNGs in KITTI's format, or folders of them. Files are paired by drive,
camera and frame. Folders may be KITTI depth trees
(DRIVE/proj_depth/groundtruth/image_02/0000000005.png), densify's output
(000005/depth/image_02.png), training sets, or plain folders of equal names. A pixel that PREDICTED
lacks lowers the coverage and is no error. Numbers are means over images.

== simulate (recordings)
write the simulated street as a recording with exact ground truth
{_RECORDING}
--out DIR  folder to write into (required)
--format NAME =kitti  kitti: a KITTI raw drive; folder: numbered sweeps with densify.yaml
--frames A:B  only frames A to B-1 (default: all)
{_CAMERA}
{_OVERWRITE}

== labels (recordings)
make scene flow labels from tracked boxes and poses
{_RECORDING}
--out DIR  folder for the flow files (required)
--keys A:B[:S]  take sweeps A to B-1, every S-th (default: all)
{_CONFIG}
{_OVERWRITE}

Writes a flow file for each sweep to the next one. Its array 'valid' (N,) bool is False for points
in two boxes, just outside a box, at the bottom of a moving box, in a box that the next sweep lacks,
and where nobody drew boxes. Poses are those of the recording; --set register.source=kiss-icp
estimates them.

== train flow (recordings)
train a network for scene flow, with or without labels
{_RECORDINGS}
--out MODEL  file of the model (required)
{_OVERWRITE}
--teacher {{objective,engine,truth}} =objective  objective: the published loss; engine: this
    package's flow; truth: exact flow
--steps N  number of pairs of sweeps to train on (required)
--seed N =0  seed of the first weights and of the choice of sweeps
--device {{auto,cpu,cuda}} =auto  device to train on

densify run --flow network:MODEL uses the trained network. SPEC may also be streets[?sensor=NAME],
the default: a new simulated street for every clip of 7 sweeps.

== bench flow (bench)
compare scene flow engines on the same windows
{_RECORDINGS}
{_BENCH_KEY}
{_WINDOW}
{_CONFIG}
--methods NAME,…  the methods (default: all but paper-adam)
--truth DIR  folder of true flow from each sweep to the next one: FRAME_NEXT.npz or STAMP.feather.
    Pairs before the key are scored

Methods: ours (the configured engine, all sweeps), ours-pair (two sweeps), paper (the published
objective with our solver), paper-adam (its own solver, minutes a pair), rigid. Errors need --truth,
or a recording with exact truth. The last tables follow the Argoverse 2 challenges: points within 35
m, without the ground, moving from 0.05 m a sweep.

== bench depth (bench)
compare depth maps of several settings
{_RECORDING}
{_BENCH_KEY}
{_WINDOW}
{_CONFIG}
{_CAMERA}
--method NAME =flow  a method of densify compare
--variant TEXT+...  a name and section.key=value of other settings to compare; may be given several
    times
--scanner N  number of the scanner whose returns are the truth

Truths: on the simulated street, exact depth within reach of a scanner of the key sweep. On other
recordings, the returns of the key sweep, for maps made without it. With --scanner, the returns of
one of several scanners, for maps made without it.

== bench paper (bench)
make the tables of Pontes, Hays, Lucey (3DV 2020), beside the published figures
--flyingthings DIR  .npz files of FlyingThings3D as FlowNet3D's authors made them
--kitti DIR  .npz files of KITTI's scene flow 2015 as FlowNet3D's authors made them
--data SPEC@K,…...  recordings with frames, such as street@60,80; may be given several times
--methods NAME,…  the methods (default: the fast ones)
--model FILE...  a network of densify train flow; may be given several times
--points N =2048  points drawn from a cloud
--pairs N =0  pairs of a set; 0 takes all

A pair is a frame of a recording and the next sweep, without ego-motion (--data, default: four
streets). Without exact truth, the flow of this package is the truth. Methods: rest (nothing moves),
paper (the published objective), paper-adam (its own solver, minutes a pair), no-laplacian (Table
2), ours.

== bench doctor (bench)
measure how often densify doctor finds wrong cameras, clocks and poses
{_RECORDINGS}
{_CONFIG}

Each camera and the poses of each recording get one error after another, in both directions. The
table has the shares that the doctor calls fine, unknown, suspicious and wrong.

== bench baselines (bench)
compare simpler maps with ours on real and exact truth
--data DIR  folder of real recordings, arranged as docs/baselines.md says (default:
    $DENSIFY_TEST_DATA; without, the street)

Methods: the single sweep as measured, filled as densify fills, and filled as IP-Basic does (Ku et
al., CRV 2018); rigid accumulation; densify. Outliers are KITTI's (3 px and 5 %). Shares of fewer
than 200 pixels are not shown.

== bench gate (bench)
judge a change: the figures of 16 keys and 3 pairs beside stored ones, with their luck
--data DIR  folder of the real recordings, arranged as docs/baselines.md says (default:
    $DENSIFY_TEST_DATA; without, streets alone)
--only KIND,…  some of depth, flow, registration (default: all)
--keys NAME,…  some of the keys (default: all)
--stored FILE =tests/gate.json  stored figures to compare with
--write FILE  store the figures as they are now
--draws N =0  times that poses are moved to measure luck anew; 0 keeps the stored luck

Depth maps are compared at equal coverage, key by key. Luck is the spread of a figure when the poses
are moved by 2 mm and 0.01°. A figure is better or worse if its mean change exceeds two standard
deviations of luck and two standard errors between the keys. Registration and flow are kept between
calls while their code stays the same.

== bench training (bench)
train a network that completes depth on several kinds of maps, and test each
--data DIR  folder of real recordings (default: $DENSIFY_TEST_DATA; without, streets alone)
--out DIR =densify-out/training  folder of maps and results; the same command continues in it
--sets NAME,…  some of both, streets, KITTI, PandaSet (default: all)
--maps NAME,…  some of the kinds of maps (default: all)
--seeds N =5  networks of each set and kind of maps
--network {{small,large}} =small  0.24 million weights, or 1.2 million, for a GPU
--steps N  training steps of each network (default: 300; large: 1500)
--image-alone  train on the image alone (monocular depth)
--device {{auto,cpu,cuda}} =auto  device to train on

Networks of one seed start from the same weights and see the same crops. Tables have the mean and
its standard error over seeds. Tests: KITTI's stereo benchmark, PandaSet's second scanner, exact
depth of streets. No sweep of a test was used for training.

== bench readme (bench)
make the tables of docs/flow-results.md as Markdown on stdout; all take half an hour
[TABLE+]  flow, registration (default: all)
"""
_GROUPS = {
    "train": "train a network for scene flow",
    "bench": "measure tables: this package's methods beside published ones",
}


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse a command line, None for this process's.

    The options also hold ``verb``, such as "bench flow", the ``module`` that answers it, and
    ``command``, the text of the command.
    """
    parser = command_line()
    texts = list(sys.argv[1:] if arguments is None else arguments)
    if "" in texts:  # an empty path would be the current folder
        before = " ".join(texts[: texts.index("")][-1:])
        parser.error(f"got an empty argument after {before!r}; is a shell's variable not set?")
    options = parser.parse_args(texts)
    options.command = shlex.join(["densify", *texts])
    return options


def answers(options: argparse.Namespace) -> Iterable[Answer]:
    """Import the module of a parsed command, and return the answers of its function."""
    module = import_module(f"densify.cli.{options.module}")
    answer = getattr(module, f"answer_{options.verb.replace(' ', '_')}")
    return cast("Iterable[Answer]", answer(options))


def command_line() -> argparse.ArgumentParser:
    """Return the parser of all commands, made of the sections of the manual."""
    parser = _Parser(
        prog="densify",
        usage="densify COMMAND [SPEC] [options]",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"densify {__version__}")
    commands = parser.add_subparsers(
        prog="densify", metavar="COMMAND", required=True, help=argparse.SUPPRESS
    )
    groups: dict[str, Any] = {"": commands}
    for section in re.split("^== ", _USUAL + _MORE, flags=re.MULTILINE)[1:]:
        usage, _, epilog = section.strip().partition("\n\n")
        title, about, options = usage.split("\n", 2)
        verb, _, module = title.rstrip(")").partition(" (")
        group, _, name = verb.rpartition(" ")
        if group not in groups:
            group_parser = _add(commands, group, _GROUPS[group])
            groups[group] = group_parser.add_subparsers(metavar="WHAT", required=True)
        verb_parser = _add(groups[group], name, about, epilog)
        verb_parser.set_defaults(verb=verb, module=module)
        add_options(verb_parser, f"--json  print the results as one JSON object\n{options}")
    abouts = [f"  {name:<10}{verb.description}" for name, verb in commands.choices.items()]
    num_usual = _USUAL.count("== ")
    usual, more = "\n".join(abouts[:num_usual]), "\n".join(abouts[num_usual:])
    parser.description = (
        "Dense depth maps from lidar recordings, with the moving objects kept sharp.\n\n"
        f"commands:\n{usual}\n\nmore:\n{more}"
    )
    parser.epilog = (
        "densify COMMAND --help explains a command. A first try: densify run --key 120\n"
        "Exit codes: 0 done, 1 the computation failed, 2 bad input, 130 interrupted."
    )
    return parser


def _add(commands: Any, name: str, about: str, epilog: str = "") -> argparse.ArgumentParser:
    """Add a command or a group of commands, and return its parser."""
    description = f"{about[0].upper()}{about[1:]}."
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=about, description=description, epilog=epilog or None
    )
    return parser


class _Parser(argparse.ArgumentParser):
    """A parser with one-line errors and suggested words, which refuses abbreviated options."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, allow_abbrev=False)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the arguments. Refuse an unknown option here, where the command is known."""
        options, unknown = super().parse_known_args(args, namespace)
        misspelt = next((text for text in unknown if text.startswith("--")), None)
        if misspelt is not None:
            name = misspelt.partition("=")[0]
            hint = did_you_mean(name, self._option_string_actions)
            self.error(f"unknown option {name}; {hint}".rstrip("; "))
        return options, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a word that is not among the choices, and suggest one."""
        if action.choices is not None and value not in action.choices:
            expected = f"expected one of {', '.join(map(str, action.choices))}"
            hint = did_you_mean(str(value), action.choices)
            raise argparse.ArgumentError(action, f"got {value!r}; {hint}{expected}")

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print the message, and let errors of writing through."""
        if message:
            print(message, end="", file=file or sys.stderr)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"densify: {shorten_message(message)}; see {self.prog} --help\n")
