import meshes as made
import numpy as np
import pytest
import trimesh
from clouds import whole
from PIL import Image
from refusals import assert_refused
from scans import read_cloud
from scipy.spatial.transform import Rotation

from piccolo.cloud.cloud_settings import CloudSettings
from piccolo.cloud.readers import mesh as mesh_module, mesh_loading
from piccolo.cloud.readers.mesh import compute_weights, look_up_texels, open_mesh
from piccolo.cloud.readers.ply import open_ply
from piccolo.cloud.stream import open_cloud
from piccolo.geometry.colors import linear_to_srgb, srgb_to_linear


def test_an_obj_texture_stands_upright_in_any_encoding(tmp_path):
    made.assert_quadrants(whole(open_mesh, made.write_obj(tmp_path)))
    path = made.write_obj(tmp_path, texture=made.png(format="JPEG", quality=100, subsampling=0))
    made.assert_quadrants(whole(open_mesh, path), tolerance=12)
    image = Image.open(tmp_path / "wall.png")
    image.quantize(8).save(tmp_path / "wall.png", "PNG")
    made.assert_quadrants(whole(open_mesh, path), tolerance=12)


@pytest.mark.parametrize("kind", ["glb", "gltf", "buffer beside"])
def test_a_gltf_texture_stands_upright(tmp_path, kind):
    gltf = made.textured_gltf()
    if kind == "glb":
        path = gltf.glb(tmp_path / "a.glb")
    else:
        path = gltf.gltf(tmp_path / "a.gltf", "a b.bin" if kind == "buffer beside" else None)
    made.assert_quadrants(whole(open_mesh, path))


def test_y_is_up_in_gltf_by_its_specification_and_z_in_other_meshes(tmp_path):
    assert open_mesh(made.textured_gltf().glb(tmp_path / "a.glb")).up == "y"
    assert open_mesh(made.write_obj(tmp_path)).up == "z"


def test_a_glb_by_trimesh_stands_upright(tmp_path):
    image = Image.fromarray(made.QUADRANTS)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    visual = trimesh.visual.TextureVisuals(uv=made.UV_FROM_BELOW, material=material)
    trimesh.Trimesh(made.SQUARE, made.TRIANGLES, visual=visual, process=False).export(tmp_path / "a.glb")
    made.assert_quadrants(whole(open_mesh, tmp_path / "a.glb"))


@pytest.mark.parametrize("text", [False, True])
def test_a_ply_texture_stands_upright(tmp_path, text):
    (tmp_path / "wall.png").write_bytes(made.png())
    options = {"text": text, "comments": ["TextureFile wall.png"]}
    path = made.write_ply(tmp_path / "a.ply", uv=made.UV_FROM_BELOW, options=options)
    made.assert_quadrants(whole(open_ply, path))


@pytest.mark.parametrize("shift", [(1, 0), (-3, 2), (0, -1)])
def test_textures_repeat(tmp_path, shift):
    uv = made.UV_FROM_BELOW + np.array(shift)
    made.assert_quadrants(whole(open_mesh, made.write_obj(tmp_path, uv=uv)))
    gltf = made.Gltf()
    gltf.node(mesh=gltf.mesh(uv=made.UV_FROM_ABOVE + np.array(shift), material=gltf.material(made.png())))
    made.assert_quadrants(whole(open_mesh, gltf.glb(tmp_path / "a.glb")))


def test_look_up_against_texels_named_by_their_place():
    texels = np.arange(3 * 5 * 4, dtype=np.uint8).reshape(3, 5, 4)
    for row in range(3):
        for column in range(5):
            uv = np.array([[(column + 0.5) / 5 + 7, 1 - (row + 0.5) / 3 - 4]])
            np.testing.assert_array_equal(look_up_texels(texels, uv)[0], texels[row, column])
    assert look_up_texels(texels, np.array([[-1e-18, 1e-18]])).shape == (1, 4)


def test_several_materials_and_quads(tmp_path):
    mtl = "newmtl wall\nmap_Kd wall.png\nnewmtl door\nKd 0.2 0.4 0.6\n"
    path = made.write_obj(tmp_path, mtl=mtl, triangles=np.array([[0, 1, 2, 3]]))
    text = path.read_text() + "".join(f"v {x} {y} 1\n" for x, y, _ in made.SQUARE.tolist())
    path.write_text(text + "usemtl door\nf 5 6 7 8\n")
    raw = whole(open_mesh, path)
    is_door = raw.points_world[:, 2] > 0.5
    assert np.unique(raw.colors[is_door], axis=0).tolist() == [[51, 102, 153]]
    assert np.count_nonzero(is_door) == 10_000
    made.assert_quadrants(type(raw)(raw.points_world[~is_door], raw.colors[~is_door]))


def test_gltf_nodes_turn_shift_and_scale(tmp_path):
    rotation = Rotation.from_euler("xyz", [20, -35, 110], degrees=True)
    inner = np.eye(4)
    inner[:3, :3] = 0.5 * Rotation.from_rotvec([0.3, 0.9, -0.2]).as_matrix()
    inner[:3, 3] = [1, -2, 3]
    gltf = made.Gltf()
    mesh = gltf.mesh(material=gltf.material(made.png()))
    child = gltf.node(is_root=False, mesh=mesh, matrix=inner.T.reshape(-1).tolist())
    translation, scale = [4.0, 5.0, -6.0], [2.0, 3.0, 0.5]
    gltf.node(children=[child], translation=translation, scale=scale, rotation=rotation.as_quat().tolist())
    raw = whole(open_mesh, gltf.glb(tmp_path / "a.glb"))
    in_inner = rotation.inv().apply(raw.points_world - translation) / scale
    in_square = (in_inner - inner[:3, 3]) @ np.linalg.inv(inner[:3, :3]).T
    is_clear = np.all(np.abs(in_square[:, :2] - 0.5) > 1e-6, axis=1)
    np.testing.assert_allclose(in_square[:, 2], 0, atol=1e-12)
    edges = rotation.apply((made.SQUARE[[1, 3]] @ inner[:3, :3].T) * scale)
    area = np.linalg.norm(np.cross(*edges))
    assert len(raw.colors) == pytest.approx(10_000 * area, rel=0.001)
    for color, corner in made.CORNERS.items():
        is_here = is_clear & np.all((in_square[:, :2] > 0.5) == corner, axis=1)
        assert np.unique(raw.colors[is_here], axis=0).tolist() == [list(color)]


def test_a_mesh_placed_twice_and_texels_of_alpha_0(tmp_path):
    gltf = made.textured_gltf(translation=[0, 0, 5.0])
    gltf.node(mesh=0, scale=[1, 2, 1])
    raw = whole(open_mesh, gltf.glb(tmp_path / "a.glb"))
    near = raw.points_world[:, 2] < 1
    assert (np.count_nonzero(near), np.count_nonzero(~near)) == (20_000, 10_000)
    alpha = np.full((8, 8, 1), 255, np.uint8)
    alpha[:4, 4:] = 0  # the green ones
    texture = made.png(np.concatenate([made.QUADRANTS, alpha], axis=2))
    raw = whole(open_mesh, made.write_obj(tmp_path, texture=texture))
    assert len(raw.colors) == pytest.approx(7500, rel=0.02)
    assert not np.any(np.all(raw.points_world[:, :2] > 0.5, axis=1))


def test_the_order_and_number_of_surfaces_are_no_chance(tmp_path, monkeypatch):
    """trimesh would give the nodes of a mesh of several parts random names, of which some may be alike."""
    monkeypatch.setattr("trimesh.util.unique_id", lambda length: "0" * length)
    gltf = made.textured_gltf()
    primitives = gltf.tree["meshes"][0]["primitives"]
    for i in range(1, 9):
        part = gltf.mesh(made.SQUARE * i / 8, colors=made.CORNER_COLORS)
        primitives += gltf.tree["meshes"][part]["primitives"]
    gltf.node(mesh=0, translation=[0, 0, 3])
    path = gltf.glb(tmp_path / "a.glb")
    first = whole(open_mesh, path)
    again = whole(open_mesh, path)
    assert again.points_world.tobytes() == first.points_world.tobytes()
    assert again.colors.tobytes() == first.colors.tobytes()
    assert len(first.colors) == round(2 * 10_000 * (1 + sum((i / 8) ** 2 for i in range(1, 9))))


def test_density_is_the_same_on_large_and_small_triangles(tmp_path):
    rng = np.random.default_rng(3)
    sizes = 10 ** rng.uniform(-3, -0.8, 4000)
    corners = rng.uniform(0, 50, (4000, 1, 3)) + sizes[:, None, None] * rng.normal(size=(4000, 3, 3))
    vertices = np.concatenate([corners.reshape(-1, 3), rng.uniform(size=(12_000, 3))], axis=1)
    path = tmp_path / "a.obj"
    triangles = np.arange(12_000).reshape(-1, 3)
    path.write_text(made.obj_text(vertices, None, triangles, library="", material=""))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(normals, axis=1)
    source = open_mesh(path)
    raw = whole(open_mesh, path)
    assert source.num_points == len(raw.colors) == round(10_000 * areas.sum())
    # the triangles in the file's order: each has its share to within a point
    shares = np.concatenate([[0], np.cumsum(areas)]) * 10_000
    first = np.ceil(shares - 0.5).astype(int)
    for i in range(0, 4000, 37):
        points = raw.points_world[first[i] + 1 : max(first[i + 1] - 1, 0)]
        if len(points):
            plane = (points - corners[i, 0]) @ (normals[i] / np.linalg.norm(normals[i]))
            np.testing.assert_allclose(plane, 0, atol=1e-9)
    small = areas < np.median(areas)
    assert np.diff(first)[small].sum() == pytest.approx(10_000 * areas[small].sum(), rel=0.02)


def test_points_leave_no_gaps_and_no_clumps(tmp_path):
    points = whole(open_mesh, made.write_obj(tmp_path)).points_world
    counts = np.histogram2d(points[:, 0], points[:, 1], bins=20)[0]
    assert abs(counts - 25).max() <= 7  # chance would give +-18
    weights = compute_weights(np.arange(30_000_000 - 9000, 30_000_000))
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(weights.mean(axis=0), 1 / 3, atol=1e-3)


def test_chunks_and_readings_change_no_bit(tmp_path, read_by):
    path = made.write_obj(tmp_path)
    source = open_mesh(path)
    first = [raw.points_world for raw in source.read_chunks()]
    read_by(777)
    again = [raw.points_world for raw in source.read_chunks()]
    assert (len(first), len(again)) == (1, 13)
    np.testing.assert_array_equal(np.concatenate(again), first[0])


def test_too_many_points_lower_the_density(tmp_path, monkeypatch):
    monkeypatch.setattr(mesh_module, "MAX_MESH_POINTS", 2000)
    source = open_mesh(made.write_obj(tmp_path))
    assert source.num_points == 2000
    assert "1 square metres of surface, sampled with 2e+03 points" in source.warnings[0]
    assert sum(len(raw.colors) for raw in source.read_chunks()) == 2000


@pytest.mark.parametrize(("unit", "scale"), [("mm", 0.001), ("km", 1000.0), ("ft", 0.3048)])
def test_density_counts_by_square_metres(tmp_path, unit, scale):
    """A square metre in any unit, as OBJ and as PLY, gives the same 10,000 points."""
    path = made.write_obj(tmp_path, vertices=made.SQUARE / scale)
    colors = np.array(made.CORNER_COLORS[:, :3] * 255, "u1")
    ply = made.write_ply(tmp_path / "a.ply", made.SQUARE / scale, colors=colors)
    for source in (path, ply):
        (opened,) = open_cloud([source], CloudSettings(scale=scale)).sources
        assert abs(opened.num_points - 10_000) <= 1
        assert opened.warnings == ()
    cloud = read_cloud(path, CloudSettings(scale=scale))
    extent = np.ptp(cloud.points, axis=0)
    np.testing.assert_allclose(extent, [1, 1, 0], atol=0.01)


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
    path = tmp_path / "a.obj"
    colors = made.CORNER_COLORS / 255
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
    decode = mesh_loading.Texture.texels
    calls = []
    monkeypatch.setattr(mesh_loading.Texture, "texels", lambda self: calls.append(self) or decode(self))
    gltf = made.Gltf()
    pictures = made.QUADRANTS, made.QUADRANTS[::-1].copy()
    first, other = (gltf.material(made.png(pixels)) for pixels in pictures)
    rows = [gltf.mesh(made.SQUARE + np.float32(i), material=other if i == 2 else first) for i in range(5)]
    gltf.tree["meshes"] = [{"primitives": [gltf.tree["meshes"][i]["primitives"][0] for i in rows]}]
    gltf.node(mesh=0)
    raw = whole(open_mesh, gltf.glb(tmp_path / "a.glb"))
    assert len(raw.colors) == 50_000
    assert len(calls) == 2


def test_points_of_gltf_are_read_as_they_are_and_whole_numbers_by_the_scale_of_their_node(tmp_path):
    gltf = made.Gltf()
    colors = np.array([[10, 20, 30], [40, 50, 60], [70, 80, 90]], np.uint8)
    mesh = gltf.mesh(np.eye(3), None, np.rint(255 * srgb_to_linear(colors)).astype(np.uint8))
    gltf.tree["meshes"][mesh]["primitives"][0] |= {"mode": 0}
    del gltf.tree["meshes"][mesh]["primitives"][0]["indices"]
    gltf.node(mesh=mesh, scale=[2.0, 2.0, 2.0], translation=[1.0, 0.0, 0.0])
    raw = whole(open_mesh, gltf.glb(tmp_path / "a.glb"))
    np.testing.assert_allclose(raw.points_world, 2.0 * np.eye(3) + [1, 0, 0])
    assert np.abs(raw.colors.astype(int) - colors).max() <= 6, "of 8 bits of linear light"
    gltf = made.Gltf()
    mesh = gltf.mesh(made.SQUARE, None, np.arange(3 * len(made.SQUARE), dtype=np.uint8).reshape(-1, 3))
    row = gltf.accessor(np.rint(100 * made.SQUARE).astype(np.uint16))
    gltf.tree["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"] = row
    gltf.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    gltf.node(mesh=mesh, scale=[0.01] * 3)
    assert_refused("POSITION of whole numbers for fractions", open_mesh, gltf.glb(tmp_path / "b.glb"))
    del gltf.tree["accessors"][row]["normalized"]
    found = whole(open_mesh, gltf.glb(tmp_path / "c.glb")).points_world
    np.testing.assert_allclose(np.ptp(found, axis=0), np.ptp(made.SQUARE, axis=0), atol=0.02)


def test_vertices_of_an_obj_without_faces_are_points(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0 1 0 0\nv 1 2 3 0 0.2 1\n")
    raw = whole(open_mesh, path)
    np.testing.assert_array_equal(raw.points_world, [[0, 0, 0], [1, 2, 3]])
    np.testing.assert_array_equal(raw.colors, [[255, 0, 0], [0, 51, 255]])
