"""Results: one with all its fields set, and those of photos of a phone."""

import numpy as np

from piccolo.geometry.pose import Pose, exp_so3
from piccolo.judge.belief import make_belief
from piccolo.judge.pose_covariance import PoseCovariance
from piccolo.judge.result import Result
from piccolo.judge.result_parts import Alternative, Beside, Evidence, Source
from piccolo.photo.camera import Mount
from piccolo.photo.camera.model import pinhole

POSE = Pose(exp_so3(np.array([0.3, -0.2, 0.9])), np.array([500_000.123, 4_000_000.456, 12.0]))
EVIDENCE = Evidence(0.7, 0.5, 0.8, 0.6, 0.9, 0.5)
ELSEWHERE = Pose(exp_so3(np.array([0.1, 0.2, -2.0])), np.array([1.0, 2.0, 3.0]))
ALTERNATIVE = Alternative(ELSEWHERE, 0.2, 7, 0.008)
RESULT = Result(
    status="localized",
    confidence=0.99,
    cloud="a scan.ply",
    pano="b.jpg",
    best_pose=POSE,
    loss=0.05,
    evidence=EVIDENCE,
    alternatives=(ALTERNATIVE,),
    covariance=PoseCovariance(np.diag([1e-6, 1e-6, 1e-6, 4e-6, 9e-6, 16e-6]), "up and down"),
    seconds={"read": 0.1, "search": 0.2},
    settings={"preset": "default", "seed": 0},
    warnings=("odd",),
    source=Source("0" * 64, "1" * 64, (2048, 1024), "2026-11-22T10:00:00+01:00"),
    probability_none=0.002,
    belief=make_belief([0.99, 0.008]),
    storey=2,
    height_above_floor=1.51,
)

PHONE = (Mount(pinhole(1024, 512, 400.0)),)
NONE_ASKED = Beside((), "0" * 64)
NOWHERE = Pose(np.eye(3), np.zeros(3))


def phone_result(pano, status="localized", beside=None, cameras=PHONE, confidence=0.95):
    """The result of a photo of a phone; nothing of its pose matters."""
    source = Source(None, "1" * 64, (1024, 512))
    about = {"beside": beside, "cameras": cameras, "source": source}
    if status in ("unreadable", "failed"):
        return Result(status, 0.0, "a.ply", pano, error="it is broken", source=source)
    return Result(status, confidence, "a.ply", pano, NOWHERE, **about)
