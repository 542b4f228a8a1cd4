"""Own arrays, cell by cell: python examples/own_arrays.py scan.ply query.jpg."""

# %% Paths
import sys

import numpy as np
from PIL import Image
from plyfile import PlyData

import piccolo

if len(sys.argv) != 3:
    sys.exit(__doc__)
scan_path, photo_path = sys.argv[1:]

# %% A scan: points (N, 3) [m] and colours (N, 3), here without what is more than 20 m from the middle
vertices = PlyData.read(scan_path)["vertex"]
points = np.stack([vertices[axis] for axis in ("x", "y", "z")], axis=1)
colors = np.stack([vertices[channel] for channel in ("red", "green", "blue")], axis=1)
is_near = np.linalg.norm(points - np.median(points, axis=0), axis=1) < 20.0
scan = piccolo.open_scan(piccolo.Cloud(points[is_near], colors=colors[is_near]))

# %% A photo: (H, W, 3) in uint8, and a mask (H, W), True where a tripod hides the floor
image = np.array(Image.open(photo_path).convert("RGB"))
height = len(image)
elevation_deg = 90.0 - 180.0 * (np.arange(height) + 0.5) / height
is_ignored = np.broadcast_to(elevation_deg[:, None] < -60.0, image.shape[:2])

# %% The camera was upright, and between 0.5 and 2.2 m above the floor
photo = piccolo.Photo(image, mask=is_ignored)
result = scan.localize(photo, prior=piccolo.Prior(height=(0.5, 2.2)), gravity="known")
print(result.summary())

# %% Where the camera is among the points
if result.pose is not None:
    distances = np.linalg.norm(points - result.pose.center_world, axis=1)
    print(f"nearest point {distances.min():.2f} m away")
