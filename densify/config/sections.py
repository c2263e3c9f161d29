# SPDX-License-Identifier: MIT
"""Every knob of the pipeline, in one place: a frozen dataclass per stage, collected in `Config`.

To add a knob, add it to a section here and run ``python tests/test_config.py``, which writes it
into configs/default.yaml. To add a section, add its class and one line in `Config`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from densify.config.errors import InputError
from densify.config.knobs import Section, knob
from densify.config.plugins import engines, outputs

_FEW_POINTS_PER_S = 800_000  # 64 rings have 1.2 million, 32 have 700,000
_AROUND_FEW_S = 0.5


@dataclass(frozen=True)
class RegisterSettings(Section):
    """The pose of the lidar at every sweep."""

    source: str = knob(
        "kiss-icp",
        "kiss-icp: estimate the poses from the sweeps; dataset: take the recording's own",
        choices=("kiss-icp", "dataset"),
    )
    voxel_size_m: float = knob(
        0.5,
        "[m] cell of KISS-ICP's local map; smaller is finer and slower, too small loses track. "
        "Sweeps of fewer than 30,000 points are aligned point to plane instead",
        0.05,
        10,
    )
    min_range_m: float = knob(2.8, "[m] nearer returns, of the own vehicle, are left out", 0, 50)
    max_range_m: float = knob(120.0, "[m] farther returns are left out", 5, 500)
    deskew: bool = knob(True, "undo the motion within each sweep; off only for compensated sweeps")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_range_m >= self.max_range_m:
            raise InputError(
                f"register.min_range_m: got {self.min_range_m:g}, expected less than "
                f"register.max_range_m = {self.max_range_m:g}"
            )


@dataclass(frozen=True)
class FlowSettings(Section):
    """Which points move, and how."""

    engine: str = knob(
        "groups", f"{engines.described()}; others by name where their package is installed"
    )
    look_around_s: float | None = knob(
        None,
        "[s] sweeps up to this long before and after the window are searched for moving points "
        "too; null: 0.5 for scanners of fewer than 800,000 points a second, else 0. With 0.5 the "
        "error falls by a third to four fifths, for twice the CPU seconds",
        0,
        5,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        engines.check_spec(self.engine)

    def around_s(self, points_per_s: float) -> float:
        """Return ``look_around_s``, for a scanner of ``points_per_s`` where it is null.

        With few points, moving objects are seen too seldom within a window.
        """
        if self.look_around_s is not None:
            return self.look_around_s
        return _AROUND_FEW_S if points_per_s < _FEW_POINTS_PER_S else 0.0


@dataclass(frozen=True)
class ObjectiveSettings(Section):
    """The published objective: engine paper, and the flow of two files without static_prior."""

    solver: str = knob(
        "pcg",
        "pcg: conjugate gradients, fast; adam: 1,500 steps as published",
        choices=("pcg", "adam"),
    )
    alpha: float = knob(10.0, "weight of smoothness; larger moves neighbours more alike", 0, 1e6)
    num_neighbors: int = knob(
        50, "neighbours of a point in the graph; more is stiffer and slower", 1, 500
    )
    static_prior: bool = knob(
        True,
        "points without a free-space violation move rigidly with the vehicle; off moves every "
        "point, with engine paper and in the flow of two files",
    )


@dataclass(frozen=True)
class AccumulateSettings(Section):
    """All points at the key's time."""

    unfollowed: str = knob(
        "drop",
        "moving points without a track. drop: leave them out; rigid: keep them where registration "
        "puts them, as ghosts",
        choices=("rigid", "drop"),
    )
    far_m: float = knob(
        40.0,
        "[m] of travel before and after the window from which static points are taken too; more "
        "covers more of far surfaces and takes longer; 0: only the window",
        0,
        500,
    )


@dataclass(frozen=True)
class ProjectSettings(Section):
    """From the accumulated cloud to each camera's depth map."""

    at: str = knob(
        "camera",
        "the time a depth map shows. camera: the image's own exposure, ego-motion and moving "
        "objects included; sweep: the key sweep's reference time",
        choices=("camera", "sweep"),
    )
    per: str = knob(
        "sweep",
        "sweep: for each camera the map of the image exposed nearest to the key sweep; image: maps "
        "of all images nearer to that sweep than to any other",
        choices=("sweep", "image"),
    )
    depth: str = knob(
        "auto",
        "the measure of depth. z: along the camera's axis; range: from the lens; auto: z for a "
        "pinhole, range for a fisheye or MEI camera, which may see behind its image plane",
        choices=("auto", "z", "range"),
    )
    visibility: bool = knob(
        True, "off: each pixel's nearest point as it is; occluded points shine through (a baseline)"
    )
    support: int = knob(
        4,
        "number of sweeps that must agree with a point, the one nearest to the key among them, at "
        "most half of all; more removes badly registered points and thins far surfaces",
        1,
        20,
    )
    rims: str = knob(
        "image",
        "pixels measured close to a depth discontinuity. image: keep those that the camera's image "
        "assigns to the measured surface (strict without an image, or with one that does not fit); "
        "strict: leave them out; keep: keep them all, which fattens outlines",
        choices=("image", "strict", "keep"),
    )
    fill_reach: float = knob(
        1.5,
        "how far the two-sided fill looks for measured pixels, in spacings of neighbouring rays; "
        "below 1 nothing is filled between the lines of a single sweep",
        0.1,
        5,
    )
    glass: str = knob(
        "plane",
        "car windows. plane: points behind them are left out, and the filled map has the plane of "
        "their frames; keep: they stay",
        choices=("plane", "keep"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.per == "image" and self.at == "sweep":
            raise InputError(
                "project.per=image: each map shows its image's own exposure; got project.at=sweep, "
                "expected camera"
            )


@dataclass(frozen=True)
class PriorSettings(Section):
    """Depth images that the user brings (--prior), where nothing is measured."""

    kind: str = knob(
        "auto",
        "what their values are. depth; inverse: inverse depth, disparity; auto: whichever fits the "
        "measured pixels better",
        choices=("auto", "depth", "inverse"),
    )


@dataclass(frozen=True)
class OutputSettings(Section):
    """Files beside those that every run writes."""

    flow: str = knob(
        "none",
        "flow/: scene flow of every sweep to the next one. npz: flow files, see docs/formats.md, "
        "towards the key; opensceneflow: an .h5 file for OpenSceneFlow, up to the key",
        choices=("none", "npz", "opensceneflow"),
    )
    optical_flow: bool = knob(
        False,
        "optical_flow/: of every pixel with a measured depth to the previous and the next image, "
        "as KITTI flow PNG",
    )
    rejected: bool = knob(
        False, "rejected/: a picture of the points that visibility rejects, and why"
    )
    report: bool = knob(
        False, "report.html: the result to look at in a browser, with output.rejected its causes"
    )
    also: str = knob(
        "", "outputs that other packages bring, by name, separated by commas; see examples/plugin"
    )
    movers: str = knob(
        "keep",
        "moving objects. keep: as all else; drop: left out of maps and cloud; separate: left out "
        "and written object by object under movers/",
        choices=("keep", "drop", "separate"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        outputs.check_also(self.also)


@dataclass(frozen=True)
class Config:
    """The whole configuration; ``Config()`` is the default one. Sections mirror the stages."""

    register: RegisterSettings = field(default_factory=RegisterSettings)
    flow: FlowSettings = field(default_factory=FlowSettings)
    objective: ObjectiveSettings = field(default_factory=ObjectiveSettings)
    accumulate: AccumulateSettings = field(default_factory=AccumulateSettings)
    project: ProjectSettings = field(default_factory=ProjectSettings)
    prior: PriorSettings = field(default_factory=PriorSettings)
    output: OutputSettings = field(default_factory=OutputSettings)


REMOVED = {
    "register": "lead_in_s max_speed_m_s min_overlap min_num_points",
    "ground": "cell_m max_slope",
    "flow": "min_height_m soft solver alpha num_neighbors static_prior",
    "objective": "radius_m laplacian max_gap_m device",
    "project": "veto_m veto_fraction footprint slack_m hidden_m hidden_fraction seen_through "
    "support_reach plane_reach agree_m agree_fraction edge_reach edge_slack_m spot edge_m "
    "edge_fraction star_reach fill_confidence",
    "prior": "far_m max_wrong",
    "output": "flow_as",
}
"""Knobs of earlier versions by section: they have a fixed value now, or another section."""
