"""Meshes' colours: of vertices, faces, materials and factors; and what trimesh would pass over in silence."""

import meshes as made
import numpy as np
import pytest
from refusals import assert_refused
from test_cloud_morton import whole

from piccolo.cloud import read_cloud
from piccolo.cloud.readers import mesh_files
from piccolo.cloud.readers.mesh import linear_to_srgb, open_mesh, srgb_to_linear
from piccolo.cloud.readers.ply import open_ply


@pytest.mark.parametrize("text", [False, True])
def test_ply_vertex_colors_are_interpolated(tmp_path, text):
    path = made.write_ply(tmp_path / "a.ply", colors=made.CORNER_COLORS, options={"text": text})
    raw = whole(open_ply, path)
    np.testing.assert_allclose(raw.colors[:, :2], 255 * raw.points_world[:, :2], atol=0.51)
    assert np.unique(raw.colors[:, 2]).tolist() == [40]
    assert len(read_cloud(path).colors) == 10_000


def test_obj_vertex_colors_come_before_the_material(tmp_path):
    vertices = np.concatenate([made.SQUARE, made.CORNER_COLORS / 255], axis=1)
    for options in ({"library": "", "material": ""}, {"mtl": "newmtl wall\nKd 1 1 1\n"}):
        raw = whole(open_mesh, made.write_obj(tmp_path, vertices=vertices, uv=None, **options))
        np.testing.assert_allclose(raw.colors[:, :2], 255 * raw.points_world[:, :2], atol=1.01)


def test_ply_face_colors_and_vertex_colors_where_no_texture_is_named(tmp_path):
    path = made.write_ply(tmp_path / "a.ply", face_colors=np.array([made.RED, made.BLUE], np.uint8))
    raw = whole(open_ply, path)
    is_first = raw.points_world[:, 0] > raw.points_world[:, 1]
    assert np.unique(raw.colors[is_first], axis=0).tolist() == [list(made.RED)]
    assert np.unique(raw.colors[~is_first], axis=0).tolist() == [list(made.BLUE)]
    raw = whole(open_ply, made.write_wedges(tmp_path / "a.ply", colors=made.CORNER_COLORS))
    np.testing.assert_allclose(raw.colors[:, 1], 255 * raw.points_world[:, 1], atol=0.51)


@pytest.mark.parametrize("type_", [np.float32, np.uint8, np.uint16])
@pytest.mark.parametrize("has_material", [False, True])
def test_gltf_vertex_colors_are_linear_light(tmp_path, type_, has_material):
    brightest = 1 if type_ == np.float32 else np.iinfo(type_).max
    gltf = made.Gltf()
    colors = np.round(made.CORNER_COLORS / 255.0, 2) * brightest
    material = gltf.material() if has_material else None
    gltf.node(mesh=gltf.mesh(uv=None, colors=colors.astype(type_), material=material))
    raw = whole(open_mesh, gltf.glb(tmp_path / "a.glb"))
    x = raw.points_world[:, 0]
    srgb = np.where(x < 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(raw.colors[:, 0], 255 * srgb, atol=1)


def test_gltf_factors_multiply_in_linear_light(tmp_path):
    gltf = made.Gltf()
    gltf.node(mesh=gltf.mesh(material=gltf.material(made.png(), (0.5, 1.0, 0.25))))
    raw = whole(open_mesh, gltf.glb(tmp_path / "a.glb"))
    red = raw.colors[np.all((raw.points_world[:, :2] > 0.5) == (0, 1), axis=1)]
    linear = ((250 / 255 + 0.055) / 1.055) ** 2.4 / 2
    expected = round(255 * (1.055 * linear ** (1 / 2.4) - 0.055))
    assert np.unique(red[:, 0]).tolist() == [expected]
    assert np.unique(red[:, 1]).tolist() == [10]
    levels = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(np.rint(255 * linear_to_srgb(srgb_to_linear(levels))), levels)


def test_surfaces_without_colors_or_area_are_left_out_with_a_warning(tmp_path):
    gltf = made.textured_gltf()
    gltf.node(mesh=gltf.mesh(uv=None), translation=[0, 0, 2.0])
    source = open_mesh(gltf.glb(tmp_path / "a.glb"))
    assert "1 surfaces without colours left out" in source.warnings[0]
    assert source.num_points == 10_000
    vertices = np.concatenate([made.SQUARE, [[np.nan, 0, 0], [0.5, 0, 0]]])
    triangles = np.concatenate([[[0, 1, 4], [0, 1, 5]], made.TRIANGLES])
    uv = np.concatenate([made.UV_FROM_BELOW, [[0, 0], [0, 0]]])
    path = made.write_obj(tmp_path, vertices=vertices, uv=uv, triangles=triangles)
    assert "2 triangles without an area or with NaN" in open_mesh(path).warnings[0]
    made.assert_quadrants(whole(open_mesh, path))


@pytest.mark.parametrize(
    "options",
    [{"library": "", "material": "", "mtl": ""}, {"mtl": "newmtl wall\nKd 1 1 1\n"}, {"material": "other"}],
)
def test_meshes_without_colors_are_refused(tmp_path, options):
    assert_refused(r"room\.obj: no colours", open_mesh, made.write_obj(tmp_path, **options))


def test_gltf_images_that_give_no_color_cameras_and_the_name_world_change_nothing(tmp_path):
    gltf = made.textured_gltf()
    gltf.tree["images"] += [{"uri": "gone.png"}, {"mimeType": "image/ktx2", "uri": "normals.ktx2"}]
    gltf.tree["textures"] += [{"source": 1}, {"extensions": {"KHR_texture_basisu": {"source": 2}}}]
    gltf.tree["materials"][0]["normalTexture"] = {"index": 1}
    gltf.tree["materials"][0]["emissiveTexture"] = {"index": 2}
    made.assert_quadrants(whole(open_mesh, gltf.glb(tmp_path / "a.glb")))
    gltf = made.textured_gltf(camera=0, name="world", translation=[0, 0, 1])
    gltf.tree["cameras"] = [{"perspective": {"znear": 0.1, "aspectRatio": 1.0, "yfov": 1.0}}]
    raw = whole(open_mesh, gltf.glb(tmp_path / "a.glb"))
    made.assert_quadrants(raw)
    assert np.all(raw.points_world[:, 2] == 1)


def test_a_second_set_of_texture_coordinates(tmp_path):
    gltf = made.textured_gltf()
    attributes = gltf.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = attributes["TEXCOORD_0"]
    attributes["TEXCOORD_0"] = gltf.accessor(np.zeros((4, 2), np.float32))
    gltf.tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 1
    made.assert_quadrants(whole(open_mesh, gltf.glb(tmp_path / "a.glb")))


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
    path, colors = tmp_path / "a.obj", made.CORNER_COLORS / 255
    vertices = np.concatenate([made.SQUARE, colors], axis=1)
    path.write_text(made.obj_text(vertices, None, library="", material=""))
    expected = whole(open_mesh, path)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    read = whole(open_mesh, path)
    np.testing.assert_array_equal(read.points_world, expected.points_world)
    np.testing.assert_array_equal(read.colors, expected.colors)


def test_materials_in_comments_are_not_used_and_textures_in_folders_below_are_found(tmp_path):
    path = made.write_obj(tmp_path, mtl="newmtl wall\nmap_Kd wall.png\nnewmtl door\nKd 1 0 0\n")
    expected = whole(open_mesh, path)
    path.write_text(path.read_text().replace("f 1/1 3/3", "# usemtl door\nf 1/1 3/3"))
    np.testing.assert_array_equal(whole(open_mesh, path).colors, expected.colors)
    path = made.write_obj(tmp_path, mtl="newmtl wall\nmap_Kd maps\\wall 1.png\n")
    (tmp_path / "maps").mkdir()
    (tmp_path / "wall.png").rename(tmp_path / "maps" / "wall 1.png")
    assert len(whole(open_mesh, path).colors) == 10_000


def test_a_textured_material_without_uv_is_left_out_whatever_its_color(tmp_path):
    mtl = "newmtl wall\nmap_Kd wall.png\nnewmtl bare\nKd 0.2 0.4 0.6\nmap_Kd wall.png\n"
    path = made.write_obj(tmp_path, mtl=mtl)
    path.write_text(path.read_text() + "usemtl bare\nf 1 2 3\n")
    source = open_mesh(path)
    assert source.num_points == 10_000
    assert "1 surfaces without colours left out" in source.warnings[0]


def test_a_texture_of_many_surfaces_is_decoded_once(tmp_path, monkeypatch):
    decode, calls = mesh_files.Texture.texels, []
    monkeypatch.setattr(mesh_files.Texture, "texels", lambda self: calls.append(self) or decode(self))
    gltf = made.Gltf()
    first, other = (
        gltf.material(made.png(pixels)) for pixels in (made.QUADRANTS, made.QUADRANTS[::-1].copy())
    )
    rows = [gltf.mesh(made.SQUARE + np.float32(i), material=other if i == 2 else first) for i in range(5)]
    gltf.tree["meshes"] = [{"primitives": [gltf.tree["meshes"][i]["primitives"][0] for i in rows]}]
    gltf.node(mesh=0)
    raw = whole(open_mesh, gltf.glb(tmp_path / "a.glb"))
    assert len(raw.colors) == 50_000
    assert len(calls) == 2
