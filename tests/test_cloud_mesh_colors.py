"""Meshes' colours: of vertices, faces, materials and factors."""

import numpy as np
import pytest
from meshes import (
    BLUE,
    CORNER_COLORS,
    RED,
    SQUARE,
    TRIANGLES,
    UV_FROM_BELOW,
    Gltf,
    assert_quadrants,
    png,
    textured_gltf,
    write_obj,
    write_ply,
)
from test_cloud_morton import whole

from piccolo.cloud import read_cloud
from piccolo.cloud.readers.mesh import open_mesh
from piccolo.cloud.readers.mesh_sampling import decoded, encoded
from piccolo.cloud.readers.ply import open_ply
from piccolo.errors import InputError


@pytest.mark.parametrize("text", [False, True])
def test_ply_vertex_colors_are_interpolated(tmp_path, text):
    path = write_ply(tmp_path / "a.ply", colors=CORNER_COLORS, options={"text": text})
    raw = whole(open_ply, path)
    np.testing.assert_allclose(raw.colors[:, :2], 255 * raw.points_world[:, :2], atol=0.51)
    assert np.unique(raw.colors[:, 2]).tolist() == [40]
    assert len(read_cloud(path).colors) == 10_000


def test_obj_vertex_colors_come_before_the_material(tmp_path):
    vertices = np.concatenate([SQUARE, CORNER_COLORS / 255], axis=1)
    for options in ({"library": "", "material": ""}, {"mtl": "newmtl wall\nKd 1 1 1\n"}):
        raw = whole(open_mesh, write_obj(tmp_path, vertices=vertices, uv=None, **options))
        np.testing.assert_allclose(raw.colors[:, :2], 255 * raw.points_world[:, :2], atol=1.01)


def test_ply_face_colors(tmp_path):
    path = write_ply(tmp_path / "a.ply", face_colors=np.array([RED, BLUE], np.uint8))
    raw = whole(open_ply, path)
    is_first = raw.points_world[:, 0] > raw.points_world[:, 1]
    assert np.unique(raw.colors[is_first], axis=0).tolist() == [list(RED)]
    assert np.unique(raw.colors[~is_first], axis=0).tolist() == [list(BLUE)]


@pytest.mark.parametrize("type_", [np.float32, np.uint8, np.uint16])
@pytest.mark.parametrize("has_material", [False, True])
def test_gltf_vertex_colors_are_linear_light(tmp_path, type_, has_material):
    brightest = 1 if type_ == np.float32 else np.iinfo(type_).max
    gltf = Gltf()
    colors = np.round(CORNER_COLORS / 255.0, 2) * brightest
    material = gltf.material() if has_material else None
    gltf.node(mesh=gltf.mesh(uv=None, colors=colors.astype(type_), material=material))
    raw = whole(open_mesh, gltf.glb(tmp_path / "a.glb"))
    x = raw.points_world[:, 0]
    srgb = np.where(x < 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(raw.colors[:, 0], 255 * srgb, atol=1)


def test_gltf_factors_multiply_in_linear_light(tmp_path):
    gltf = Gltf()
    gltf.node(mesh=gltf.mesh(material=gltf.material(png(), (0.5, 1.0, 0.25))))
    raw = whole(open_mesh, gltf.glb(tmp_path / "a.glb"))
    red = raw.colors[np.all((raw.points_world[:, :2] > 0.5) == (0, 1), axis=1)]
    linear = ((250 / 255 + 0.055) / 1.055) ** 2.4 / 2
    expected = round(255 * (1.055 * linear ** (1 / 2.4) - 0.055))
    assert np.unique(red[:, 0]).tolist() == [expected]
    assert np.unique(red[:, 1]).tolist() == [10]


def test_srgb_there_and_back():
    levels = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(np.rint(255 * encoded(decoded(levels))), levels)


def test_surfaces_without_colors_are_left_out_with_a_warning(tmp_path):
    gltf = textured_gltf()
    gltf.node(mesh=gltf.mesh(uv=None), translation=[0, 0, 2.0])
    source = open_mesh(gltf.glb(tmp_path / "a.glb"))
    assert "1 surfaces without colours left out" in source.warnings[0]
    assert source.num_points == 10_000


def test_flat_triangles_and_nan_vertices_are_left_out_with_a_warning(tmp_path):
    vertices = np.concatenate([SQUARE, [[np.nan, 0, 0], [0.5, 0, 0]]])
    triangles = np.concatenate([[[0, 1, 4], [0, 1, 5]], TRIANGLES])
    uv = np.concatenate([UV_FROM_BELOW, [[0, 0], [0, 0]]])
    path = write_obj(tmp_path, vertices=vertices, uv=uv, triangles=triangles)
    assert "2 triangles without an area or with NaN" in open_mesh(path).warnings[0]
    assert_quadrants(whole(open_mesh, path))


@pytest.mark.parametrize(
    "options",
    [
        {"library": "", "material": "", "mtl": ""},
        {"mtl": "newmtl wall\nKd 0.2 0.3 0.4\n"},
        {"material": "unknown"},
    ],
)
def test_meshes_without_colors_are_refused(tmp_path, options):
    with pytest.raises(InputError, match=r"room\.obj: no colours"):
        open_mesh(write_obj(tmp_path, **options))


def test_gltf_images_that_give_no_color_are_passed_over(tmp_path):
    gltf = textured_gltf()
    gltf.tree["images"] += [{"uri": "gone.png"}, {"mimeType": "image/ktx2", "uri": "normals.ktx2"}]
    gltf.tree["textures"] += [{"source": 1}, {"extensions": {"KHR_texture_basisu": {"source": 2}}}]
    gltf.tree["materials"][0]["normalTexture"] = {"index": 1}
    gltf.tree["materials"][0]["emissiveTexture"] = {"index": 2}
    assert_quadrants(whole(open_mesh, gltf.glb(tmp_path / "a.glb")))


def test_a_second_set_of_texture_coordinates(tmp_path):
    gltf = textured_gltf()
    attributes = gltf.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = attributes["TEXCOORD_0"]
    attributes["TEXCOORD_0"] = gltf.accessor(np.zeros((4, 2), np.float32))
    gltf.tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 1
    assert_quadrants(whole(open_mesh, gltf.glb(tmp_path / "a.glb")))
