"""Poses kept in golden/, each beside the hashes of what it was found in.

A change that moves one says so in CHANGELOG.md under Numbers, and makes the files anew:
REMAKE_GOLDEN=1 python -m pytest tests -k golden
"""

import hashlib
import json
import os
from pathlib import Path

import numpy as np
from rooms import query, room

FOLDER = Path(__file__).parent / "golden"


def _digest(*arrays):
    content = hashlib.sha256()
    for array in arrays:
        content.update(np.ascontiguousarray(array).tobytes())
    return content.hexdigest()[:16]


def check_golden_poses(name, map_arrays, localize):
    """Compare localize(seed, variant).pose with the file `name`; say which input differs where a pose does.

    map_arrays(seed) are the arrays of the prepared map.
    """
    is_remade = "REMAKE_GOLDEN" in os.environ
    entries = json.loads((FOLDER / name).read_text())
    for entry in entries:
        seed, variant = entry["seed"], entry["variant"]
        cloud = room(seed)[1]
        rgb = query(seed, variant).rgb
        arrays = {"cloud": (cloud.points, cloud.colors), "panorama": (rgb,), "map": map_arrays(seed)}
        hashes = {word: _digest(*values) for word, values in arrays.items()}
        changed = [word for word in hashes if entry["hashes"][word] != hashes[word]]
        pose = localize(seed, variant).best_pose
        R, center = pose.R_cam_from_world, pose.center_world
        if is_remade:
            entry |= {"hashes": hashes, "R_cam_from_world": R.tolist(), "center_world": center.tolist()}
        else:
            told = f"{seed} {variant}: " + (f"another {', '.join(changed)}" if changed else "the same input")
            assert np.linalg.norm(center - entry["center_world"]) < 0.001, told
            assert np.abs(R - entry["R_cam_from_world"]).max() < np.radians(0.01), told
    if is_remade:
        (FOLDER / name).write_text(json.dumps(entries, indent=1) + "\n")
