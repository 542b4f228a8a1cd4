"""One scan in every format, read by localize.py with its default options, and with one and two threads."""

import numpy as np
import pytest
from batches import main_of
from e57_files import ScanToWrite, write as write_e57
from las_files import OFFSETS, las_bytes, laz_bytes
from meshes import Gltf, obj_text
from pcd_files import ENCODINGS, content_of
from plyfile import PlyData, PlyElement
from rooms import assert_near
from scipy.spatial import cKDTree

from piccolo.cloud.readers.reader import RawCloud
from piccolo.cloud.stream import FORMATS, open_cloud
from piccolo.geometry.colors import srgb_to_linear
from piccolo.geometry.pose import Pose
from piccolo.judge.result import Result
from piccolo.system.jobs.threads import Workers
from research.scene import read_scene

TIER = "scene"

UNTURNED = np.eye(3)
EAST_UP_SOUTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # glTF's axes from x y z
SIDE = 0.0142  # [m] of a triangle's legs, so that it gives one point
LEGS = SIDE * np.array([[-1 / 3, -1 / 3, 0.0], [2 / 3, -1 / 3, 0.0], [-1 / 3, 2 / 3, 0.0]])
# where the scanner stood, and its axes
SETUPS = (
    "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1",
    "1 2 3\n0 1 0\n-1 0 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n1 2 3 1",
)


@pytest.fixture(scope="module")
def raw(scene):
    """An eighth of the points of the scene."""
    vertices = PlyData.read(scene / "cloud.ply")["vertex"].data[::8]
    points = np.stack([vertices[name] for name in "xyz"], axis=1).astype(np.float64)
    return RawCloud(points, np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1))


def _write_ply(**options):
    def write(path, raw):
        fields = [(name, "f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
        rows = np.rec.fromarrays([*raw.points_world.T, *raw.colors.T], dtype=fields)
        PlyData([PlyElement.describe(rows, "vertex")], **options).write(path)

    return write


def _write_e57(path, raw):
    columns = {f"cartesian{name}": column for name, column in zip("XYZ", raw.points_world.T, strict=True)}
    names = ("colorRed", "colorGreen", "colorBlue")
    columns |= {name: column.astype(np.int64) for name, column in zip(names, raw.colors.T, strict=True)}
    write_e57(path, [ScanToWrite(columns, dict.fromkeys(names, (0, 255)))])


def _write_pcd(encoding):
    def write(path, raw):
        packed = (raw.colors.astype(np.uint32) << [16, 8, 0]).sum(axis=1, dtype=np.uint32)
        fields = [(name, "f4", 1, column) for name, column in zip("xyz", raw.points_world.T, strict=True)]
        path.write_bytes(content_of([*fields, ("rgb", "u4", 1, packed)], encoding, len(packed)))

    return write


def _write_ptx(path, raw):
    half = len(raw.colors) // 2
    east, north, up = raw.points_world[half:].T
    turned = np.stack([north - 2.0, 1.0 - east, up - 3.0], axis=1)  # as the second setup sees them
    with path.open("w") as file:
        for setup, points, colors in (
            (SETUPS[0], raw.points_world[:half], raw.colors[:half]),
            (SETUPS[1], turned, raw.colors[half:]),
        ):
            file.write(f"{len(points)}\n1\n{setup}\n")
            _write_rows(file, points, colors, "%.4f %.4f %.4f 0.5 %d %d %d")


def _write_rows(path, points, colors, form="%.4f %.4f %.4f %d %d %d"):
    np.savetxt(path, np.hstack([points, colors]), form)


def _write_pts(path, raw):
    with path.open("w") as file:
        file.write(f"{len(raw.colors)}\n")
        _write_rows(file, raw.points_world, raw.colors, "%.4f %.4f %.4f 17 %d %d %d")


def _write_obj(path, raw):
    corners, triangles = _triangles(raw.points_world)
    rows = np.hstack([corners, raw.colors.repeat(3, axis=0) / 255.0])
    path.write_text(obj_text(rows, None, triangles, library="", material=""))


def _write_gltf(path, raw):
    corners, triangles = _triangles(raw.points_world)
    light = srgb_to_linear(raw.colors).astype(np.float32).repeat(3, axis=0)
    gltf = Gltf()
    gltf.node(mesh=gltf.mesh(corners @ EAST_UP_SOUTH.T, None, light, triangles))
    (gltf.glb if path.suffix == ".glb" else gltf.gltf)(path)


def _triangles(points):
    """The corners (3 N, 3) of a small triangle at each point, and their rows (N, 3)."""
    return (points[:, None] + LEGS).reshape(-1, 3), np.arange(3 * len(points)).reshape(-1, 3)


def _write_las(path, raw):
    content = las_bytes(RawCloud(raw.points_world + OFFSETS, raw.colors), 7)
    path.write_bytes(laz_bytes(content) if path.suffix == ".laz" else content)


WRITERS = {
    "binary.ply": _write_ply(),
    "ascii.ply": _write_ply(text=True),
    "big-endian.ply": _write_ply(byte_order=">"),
    "a.las": _write_las,
    "a.laz": _write_las,
    "a.e57": _write_e57,
    **{f"{encoding}.pcd": _write_pcd(encoding) for encoding in ENCODINGS},
    "a.ptx": _write_ptx,
    "a.pts": _write_pts,
    "a.npz": lambda path, raw: np.savez(path, points=raw.points_world, colors=raw.colors),
    "a.npy": lambda path, raw: np.save(path, np.hstack([raw.points_world, raw.colors])),
    "a.obj": _write_obj,
    "a.glb": _write_gltf,
    "a.gltf": _write_gltf,
    "a.txt": lambda path, raw: _write_rows(path, *raw),
    "a.xyz": lambda path, raw: _write_rows(path, *raw),
    "a.asc": lambda path, raw: _write_rows(path, *raw),
    "a.csv": lambda path, raw: _write_rows(path, *raw, form="%.4f,%.4f,%.4f,%d,%d,%d"),
    "a.xyzrgb": lambda path, raw: _write_rows(path, *raw),
}
# the file's axes from the scene's, and its origin
PLACES = dict.fromkeys(("a.las", "a.laz"), (UNTURNED, OFFSETS))
PLACES |= dict.fromkeys(("a.glb", "a.gltf"), (EAST_UP_SOUTH, np.zeros(3)))


def test_every_format_has_a_sample():
    suffixes = {name[name.rindex(".") :] for name in WRITERS}
    assert suffixes == {suffix for form in FORMATS for suffix in form.suffixes}


@pytest.mark.parametrize("name", WRITERS)
def test_a_scan_in_any_format_is_read_with_any_number_of_threads(name, raw, scene, tmp_path, capsys, read_by):
    path = tmp_path / name
    WRITERS[name](path, raw)
    true = read_scene(scene).by_name["clean_0.jpg"].pose
    R_file_from_scene, origin = PLACES.get(name, (UNTURNED, np.zeros(3)))
    pose = Pose(true.R_cam_from_world @ R_file_from_scene.T, R_file_from_scene @ true.center_world + origin)
    near = ["--near", *(f"{x:.1f}" for x in pose.center_world), "0.7"]
    words = ["--cloud", str(path), "--pano", str(scene / "images" / "clean_0.jpg"), *near]
    found = []
    for more in [[], ["--threads", "1"], ["--threads", "2"]] if name == "binary.ply" else [[]]:
        code = main_of("localize.py")([*words, *more, "--cache", "none", "--quiet"])
        out, err = capsys.readouterr()
        assert (code, err) == (0, ""), more
        found.append(Result.from_json(out).pose)
        assert_near(found[-1], pose, 0.03, 0.5)
        assert np.array_equal(found[-1].center_world, found[0].center_world)
    cloud = open_cloud([path]).read()
    points = (cloud.points + cloud.origin_world - origin) @ R_file_from_scene
    distances, nearest = cKDTree(points).query(raw.points_world)
    assert distances.max() < SIDE
    is_alike = np.abs(cloud.colors[nearest].astype(int) - raw.colors).max(axis=1) <= 1
    assert is_alike.mean() > 0.95  # points of triangles may lie nearer to others
    read_by(4000, 50_000)  # in several parts
    one, two = (open_cloud([path]).voxels(UNTURNED, Workers(num_threads)) for num_threads in (1, 2))
    assert np.array_equal(one.codes, two.codes)
    assert np.array_equal(one.nodes, two.nodes)
