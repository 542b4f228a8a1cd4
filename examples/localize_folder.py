"""Localize a folder of photos with priors: python examples/localize_folder.py scan.ply photos priors.csv.

The CSV has the columns name,x,y,z,radius: the camera of photos/NAME was within `radius` [m] of (x, y, z) [m].
A photo without a row is searched everywhere.
"""

import csv
import sys
from pathlib import Path

import piccolo


def read_priors(path: str) -> dict[str, piccolo.Prior]:
    """Return what is known of each photo, by its name."""
    priors: dict[str, piccolo.Prior] = {}
    with Path(path).open(newline="") as file:
        for row in csv.DictReader(file):
            near = float(row["x"]), float(row["y"]), float(row["z"])
            priors[row["name"]] = piccolo.Prior(near=near, radius=float(row["radius"]))
    return priors


def main(scan_path: str, folder: str, priors_path: str) -> None:
    """Print a line of CSV a photo; one that can't be read is named on stderr, and the others go on."""
    scan = piccolo.open_scan(scan_path)
    priors = read_priors(priors_path)
    print("name,status,confidence,x,y,z")
    for photo in sorted(Path(folder).iterdir()):
        try:
            result = scan.localize(photo, prior=priors.get(photo.name))
        except piccolo.InputError as error:
            print(error, file=sys.stderr)
            continue
        center = ["", "", ""] if result.pose is None else [f"{x:.3f}" for x in result.pose.center_world]
        print(",".join([photo.name, result.status, f"{result.confidence:.3f}", *center]))


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
