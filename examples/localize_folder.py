"""Localize a folder of photos with priors: python examples/localize_folder.py scan.ply photos priors.csv.

The CSV has the columns name,x,y,z,radius: the camera of photos/NAME was within `radius` [m] of (x, y, z) [m].
A photo without a row is searched everywhere.
"""

import csv
import sys
from pathlib import Path

import piccolo

Place = tuple[float, float, float]


def read_priors(path: str) -> dict[str, tuple[Place, float]]:
    """Return the place and its radius by the photo's name."""
    priors: dict[str, tuple[Place, float]] = {}
    with Path(path).open(newline="") as file:
        for row in csv.DictReader(file):
            near_world = float(row["x"]), float(row["y"]), float(row["z"])
            priors[row["name"]] = near_world, float(row["radius"])
    return priors


def main(scan_path: str, folder: str, priors_path: str) -> None:
    """Print a line of CSV a photo; one that can't be read is named on stderr, and the others go on."""
    scan = piccolo.open_scan(scan_path)
    priors = read_priors(priors_path)
    print("name,status,confidence,x,y,z")
    for photo in sorted(Path(folder).iterdir()):
        try:
            near_world, radius = priors.get(photo.name, (None, None))
            result = scan.localize(photo, near_world=near_world, radius=radius)
        except piccolo.InputError as error:
            print(error, file=sys.stderr)
            continue
        center = ["", "", ""] if result.pose is None else [f"{x:.3f}" for x in result.pose.center_world]
        print(",".join([photo.name, result.status, f"{result.confidence:.3f}", *center]))


if __name__ == "__main__":
    main(*sys.argv[1:])
