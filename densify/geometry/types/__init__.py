# SPDX-License-Identifier: MIT
"""Define the types that stages hand to each other.

All types are frozen. Per-point arrays of an object are aligned row by row. Poses are named
``T_target_source``: ``p_target = T_target_source @ p_source``. Frames of reference: ``world`` (the
first sweep's lidar), ``lidar`` (at the sweep's reference time), ``key`` (the key sweep's lidar at
its reference time), ``cam`` (x right, y down, z forward). As arguments, ``key`` is the frame number
of the key sweep, ``stretch`` holds the registered sweeps of its window.
"""

from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.types.recordings import (
    Boxes,
    BoxView,
    Camera,
    FlowField,
    LidarSequence,
    Motion,
    RegisteredSweep,
    Stretch,
    StretchFlow,
    Sweep,
    SweepTruth,
    Trajectory,
    Truth,
)
from densify.geometry.types.results import (
    METHOD_NAMES,
    CameraView,
    Cloud,
    DepthMap,
    FullDepth,
    Mover,
    ObjectTrack,
    Patches,
    Prior,
    PriorFit,
    Progress,
    Reason,
    Rejected,
    Result,
    StageCost,
    StaticWorld,
)
