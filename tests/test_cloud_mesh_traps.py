"""What trimesh would pass over in silence."""

import numpy as np
import pytest
from meshes import QUADRANTS, SQUARE, UV_FROM_ABOVE, Gltf, obj_text, png, write_obj
from test_cloud_morton import whole

from piccolo.cloud.readers import mesh_gltf, mesh_texture
from piccolo.cloud.readers.mesh import open_mesh
from piccolo.cloud.readers.ply import open_ply
from piccolo.errors import InputError

COLORS = np.array([[10, 0, 40], [250, 0, 40], [250, 250, 40], [0, 250, 40]], np.float64)
PLY_HEAD = """ply
format ascii 1.0
{comments}element vertex 4
property float x
property float y
property float z
{colors}element face 2
property list uchar int vertex_indices
property list uchar float texcoord
end_header
"""
WEDGES = "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 0 0.1 1 1 0 1\n"


def colored_obj(path, brightest=1.0):
    vertices = np.concatenate([SQUARE, COLORS / 255 * brightest], axis=1)
    path.write_text(obj_text(vertices, None, library="", material=""))
    return path


def write_wedges(path, textures=(), colors=None, kind="uchar"):
    names = () if colors is None else ("red", "green", "blue")
    properties = "".join(f"property {kind} {name}\n" for name in names)
    comments = "".join(f"comment TextureFile {name}\n" for name in textures)
    head = PLY_HEAD.format(comments=comments, colors=properties)
    rows = SQUARE if colors is None else np.concatenate([SQUARE, colors], axis=1)
    path.write_text(head + "".join(" ".join(f"{n:g}" for n in row) + "\n" for row in rows.tolist()) + WEDGES)
    return path


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("\nv ", "\n  v "),
        ("\nf ", "\n\tf "),
        ("\nf ", "\nf\t"),
        ("f 1 2 3", "f 1 \\\n  2 3"),
        ("\nf ", "\n  # f 9 9 9\nf "),
    ],
)
def test_obj_lines_may_begin_in_other_ways(tmp_path, old, new):
    path = colored_obj(tmp_path / "a.obj")
    expected = whole(open_mesh, path)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    read = whole(open_mesh, path)
    np.testing.assert_array_equal(read.points_world, expected.points_world)
    np.testing.assert_array_equal(read.colors, expected.colors)


def test_materials_in_comments_are_not_used(tmp_path):
    path = write_obj(tmp_path, mtl="newmtl wall\nmap_Kd wall.png\nnewmtl door\nKd 1 0 0\n")
    expected = whole(open_mesh, path)
    path.write_text(path.read_text().replace("f 1/1 3/3", "# usemtl door\nf 1/1 3/3"))
    np.testing.assert_array_equal(whole(open_mesh, path).colors, expected.colors)


def test_obj_colors_beyond_1_are_refused_not_cut_off(tmp_path):
    with pytest.raises(InputError, match="a colour of 250, wanted 0 to 1 or bytes"):
        open_mesh(colored_obj(tmp_path / "a.obj", brightest=255))


def test_ply_float_colors_beyond_1_are_refused_not_cut_off(tmp_path):
    with pytest.raises(InputError, match="a colour of 250, wanted 0 to 1 or bytes"):
        open_ply(write_wedges(tmp_path / "a.ply", colors=COLORS, kind="float"))


def test_ply_colors_stay_with_their_vertices_where_no_texture_is_named(tmp_path):
    raw = whole(open_ply, write_wedges(tmp_path / "a.ply", colors=COLORS))
    np.testing.assert_allclose(raw.colors[:, 1], 250 * raw.points_world[:, 1], atol=0.51)


def test_several_textures_of_a_ply_are_refused(tmp_path):
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(png())
    with pytest.raises(InputError, match="names 2 textures, wanted one"):
        open_ply(write_wedges(tmp_path / "a.ply", textures=("a.png", "b.png")))


def test_a_textured_material_without_uv_is_left_out_whatever_its_color(tmp_path):
    mtl = "newmtl wall\nmap_Kd wall.png\nnewmtl bare\nKd 0.2 0.4 0.6\nmap_Kd wall.png\n"
    path = write_obj(tmp_path, mtl=mtl)
    path.write_text(path.read_text() + "usemtl bare\nf 1 2 3\n")
    source = open_mesh(path)
    assert source.num_points == 10_000
    assert "1 surfaces without colours left out" in source.warnings[0]


def many_primitives(count, pixels=QUADRANTS):
    """A mesh of squares above each other that share one texture."""
    gltf = Gltf()
    material = gltf.material(png(pixels))
    meshes = [gltf.mesh(SQUARE + np.float32(i), material=material) for i in range(count)]
    primitives = [gltf.tree["meshes"][mesh]["primitives"][0] for mesh in meshes]
    gltf.tree["meshes"] = [{"primitives": primitives}]
    gltf.node(mesh=0)
    return gltf


def test_a_texture_of_many_surfaces_is_decoded_once(tmp_path, monkeypatch):
    decode, calls = mesh_texture.Texture.texels, []
    monkeypatch.setattr(mesh_texture.Texture, "texels", lambda self: calls.append(self) or decode(self))
    gltf = many_primitives(4)
    other = gltf.material(png(QUADRANTS[::-1].copy()))
    primitives = gltf.tree["meshes"][0]["primitives"]
    primitives.insert(2, primitives[0] | {"material": other})
    raw = whole(open_mesh, gltf.glb(tmp_path / "a.glb"))
    assert len(raw.colors) == 50_000
    assert len(calls) == 2


def test_colors_of_another_length_are_refused(tmp_path):
    gltf = Gltf()
    gltf.node(mesh=gltf.mesh(uv=None, colors=np.eye(3, dtype=np.float32)))
    with pytest.raises(InputError, match=r"a primitive with \[3, 4\] rows, wanted as many of each"):
        open_mesh(gltf.glb(tmp_path / "a.glb"))


def test_data_that_primitives_share_without_end_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(mesh_gltf, "MAX_ROWS", 9999)
    gltf = Gltf()
    uv = np.tile(UV_FROM_ABOVE, (500, 1))
    gltf.node(mesh=gltf.mesh(np.tile(SQUARE, (500, 1)), uv, material=gltf.material(png())))
    [primitive] = gltf.tree["meshes"][0]["primitives"]
    gltf.tree["meshes"][0]["primitives"] = 10 * [primitive]  # as some exporters do
    assert open_mesh(gltf.glb(tmp_path / "a.glb")).num_points == 100_000
    gltf.tree["meshes"][0]["primitives"] = 1000 * [primitive]
    with pytest.raises(InputError, match="over 9999 vertices and indices in"):
        open_mesh(gltf.glb(tmp_path / "a.glb"))
