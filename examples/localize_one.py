"""Localize one photo: python examples/localize_one.py scan.ply query.jpg."""

import sys

import piccolo


def main(scan_path: str, photo_path: str) -> None:
    """Print the pose of the photo, how exact it is, and which other poses come near."""
    scan = piccolo.open_scan(scan_path)
    result = scan.localize(photo_path)
    print(result.status, f"confidence {result.confidence:.3f}")
    if result.pose is not None:
        print("center_world [m]", result.pose.center_world.round(3).tolist())
        print("R_cam_from_world", result.pose.R_cam_from_world.round(4).tolist())
    if result.covariance is not None:
        print("standard deviations [mm]", result.covariance.std_mm.round(1).tolist())
    for other in result.alternatives:
        print("alternative", other.pose.center_world.round(2).tolist(), f"score {other.score:.2f}")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
