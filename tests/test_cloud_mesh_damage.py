import struct
import sys
import zlib

import numpy as np
import pytest
from meshes import (
    CORNER_COLORS,
    TRIANGLES,
    UV_FROM_BELOW,
    Gltf,
    change,
    png,
    textured_gltf,
    write_obj,
    write_ply,
)
from refusals import read_or_refused
from test_cloud_morton import whole

from piccolo.cloud import open_cloud, read_cloud
from piccolo.cloud.readers import mesh_texture
from piccolo.cloud.readers.mesh import open_mesh
from piccolo.cloud.readers.ply import open_ply
from piccolo.errors import InputError


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("../wall.png", "names in the mesh's own folder or below"),
        ("/etc/hostname", "names in the mesh's own folder or below"),
        ("https://example.com/wall.png", "names in the mesh's own folder or below"),
        ("file:///etc/hostname", "names in the mesh's own folder or below"),
        ("..\\wall.png", "names in the mesh's own folder or below"),
        ("C:\\wall.png", "names in the mesh's own folder or below"),
        ("gone.png", "which is not in its folder"),
        ("a" * 5000, "names the file"),
    ],
)
def test_references_are_held_to_the_folder(tmp_path, name, complaint):
    folder = tmp_path / "mesh"
    folder.mkdir()
    (tmp_path / "wall.png").write_bytes(png())
    gltf = textured_gltf()
    gltf.tree["images"] = [{"uri": name}]
    paths = [
        write_obj(folder, mtl=f"newmtl wall\nmap_Kd {name}\n"),
        gltf.glb(folder / "a.glb"),
        write_ply(folder / "a.ply", uv=UV_FROM_BELOW, options={"comments": [f"TextureFile {name}"]}),
    ]
    for path in paths:
        _, message = read_or_refused(read_cloud, path)
        assert complaint in message
        assert ascii(name[:100]) in message


def test_a_link_out_of_the_folder_is_refused(tmp_path):
    folder = tmp_path / "mesh"
    folder.mkdir()
    path = write_obj(folder)
    (folder / "wall.png").rename(tmp_path / "wall.png")
    (folder / "wall.png").symlink_to(tmp_path / "wall.png")
    with pytest.raises(InputError, match=r"names the file 'wall.png', wanted names in the mesh's own folder"):
        open_mesh(path)


def test_missing_materials_are_named(tmp_path):
    with pytest.raises(InputError, match=r"room\.obj: names the file 'room\.mtl', which is not in its"):
        open_mesh(write_obj(tmp_path, mtl=""))


def test_textures_in_folders_below_are_found(tmp_path):
    path = write_obj(tmp_path, mtl="newmtl wall\nmap_Kd maps\\wall 1.png\n")
    (tmp_path / "maps").mkdir()
    (tmp_path / "wall.png").rename(tmp_path / "maps" / "wall 1.png")
    assert len(whole(open_mesh, path).colors) == 10_000


def test_large_textures_are_refused_before_they_are_decoded(tmp_path, monkeypatch):
    texture = png(np.zeros((300, 300, 3), np.uint8))
    path, glb = write_obj(tmp_path, texture=texture), textured_gltf(texture).glb(tmp_path / "a.glb")
    assert len(whole(open_mesh, path).colors) == 10_000
    monkeypatch.setattr(mesh_texture, "MAX_TEXELS", 89_999)
    for mesh in (path, glb):
        with pytest.raises(InputError, match="a texture of 300 x 300 texels, wanted at most 89999"):
            open_mesh(mesh)


def test_a_texture_that_says_it_is_huge_is_refused(tmp_path):
    texture = bytearray(png())
    texture[16:24] = struct.pack(">II", 40_000, 40_000)
    texture[29:33] = struct.pack(">I", zlib.crc32(texture[12:29]))
    path = write_obj(tmp_path, texture=texture)
    ply = write_ply(tmp_path / "a.ply", uv=UV_FROM_BELOW, options={"comments": ["TextureFile wall.png"]})
    for mesh in (path, ply):
        _, message = read_or_refused(read_cloud, mesh)
        assert "a texture of 40000 x 40000 texels, wanted at most 268435456" in message


@pytest.mark.parametrize("cut", [20, 60, -30])
def test_broken_textures_are_refused(tmp_path, cut):
    noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), np.uint8)
    texture = png(noise)[:cut]
    paths = [write_obj(tmp_path, texture=texture), textured_gltf(texture).glb(tmp_path / "a.glb")]
    for path in paths:
        _, message = read_or_refused(read_cloud, path)
        assert "texture" in message
        assert "can't be read" in message


@pytest.mark.parametrize(("module", "kind"), [("trimesh", "ply"), ("trimesh", "obj"), ("PIL.Image", "glb")])
def test_missing_libraries_are_named(tmp_path, monkeypatch, module, kind):
    paths = {
        "ply": write_ply(tmp_path / "a.ply", colors=CORNER_COLORS),
        "obj": write_obj(tmp_path),
        "glb": textured_gltf().glb(tmp_path / "a.glb"),
    }
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"needs {module}.*pip install -r requirements-formats\.txt"):
        open_cloud([paths[kind]])


@pytest.mark.parametrize(
    "face", ["1/1 2/2 9/3", "-1/1 -2/2 -3/3", "0/1 1/1 2/2", "1/1 2/0 3/3", "1/1 2/2 99999999999/3"]
)
def test_wrong_indices_in_obj_are_refused(tmp_path, face):
    path = write_obj(tmp_path)
    path.write_text(path.read_text() + f"f {face}" + "\n")
    with pytest.raises(InputError, match=r"room\.obj: "):
        open_mesh(path)


@pytest.mark.parametrize(
    "text", ["", "# nothing\n", "v 0 0 0\n", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2\n", "f 1 2 3\n"]
)
def test_empty_meshes_are_refused(tmp_path, text):
    path = tmp_path / "a.obj"
    path.write_text(text)
    _, message = read_or_refused(read_cloud, path)
    assert message


PRIMITIVE = ("meshes", 0, "primitives", 0)
BASE = ("materials", 0, "pbrMetallicRoughness")


@pytest.mark.parametrize(
    ("path", "value", "complaint"),
    [
        (("accessors", 0, "count"), 10**12, "accessor 0 promises 1000000000000 rows of 12 bytes"),
        (("accessors", 0, "count"), -4, "broken JSON"),
        (("accessors", 0, "count"), 1e300, "broken JSON"),
        (("accessors", 0, "byteOffset"), 8, "accessor 0 promises 4 rows"),
        (("accessors", 0, "componentType"), 5123, "POSITION of type 5123"),
        (("accessors", 0, "bufferView"), None, "accessor 0 is sparse or compressed"),
        (("accessors", 0, "sparse"), {"count": 1}, "accessor 0 is sparse or compressed"),
        (("bufferViews", 0, "byteLength"), 10**9, "buffer view 0 lies outside its buffer"),
        (("bufferViews", 1, "byteStride"), 0, "accessor 0 promises"),
        (("bufferViews", 0, "buffer"), 7, "broken JSON"),
        (("nodes", 0, "children"), [0], "a node is named twice"),
        (("scenes", 0, "nodes"), [0, 0], "a node is named twice"),
        (("scenes", 0, "nodes"), [5], "broken JSON"),
        (("scenes", 0, "nodes"), [], "no triangles"),
        (("nodes", 0, "mesh"), 3, "no triangles"),
        (("nodes", 0, "scale"), [0, 0, 0], "an area of 0"),
        (("nodes", 0, "scale"), [1e-9, 1e-9, 1], "too small for points"),
        ((*PRIMITIVE, "mode"), 6, "triangle fans"),
        ((*PRIMITIVE, "mode"), 0, "no triangles"),
        ((*PRIMITIVE, "material"), 9, "broken JSON"),
        ((*PRIMITIVE, "attributes", "TEXCOORD_0"), None, "a texture or its coordinates are missing"),
        ((*BASE, "baseColorTexture", "texCoord"), 1, "a texture or its coordinates are missing"),
        ((*BASE, "baseColorTexture", "index"), 4, "broken JSON"),
        (
            (*BASE, "baseColorTexture", "extensions"),
            {"KHR_texture_transform": {}},
            "uses KHR_texture_transform",
        ),
        ((*BASE, "baseColorFactor"), [2, 0, 0, 1], "a base colour of 2 0 0"),
        (("extensionsRequired",), ["KHR_draco_mesh_compression"], "requires the extensions 'KHR_draco"),
        (("asset", "version"), "1.0", "trimesh can't read it"),
        (("asset",), None, "broken JSON"),
        (("meshes",), 5, "broken JSON"),
    ],
)
def test_broken_gltf_is_refused(tmp_path, path, value, complaint):
    gltf = textured_gltf()
    change(path, value)(gltf.tree)
    _, message = read_or_refused(open_mesh, gltf.glb(tmp_path / "a.glb"))
    assert complaint in message


def test_gltf_indices_out_of_range_are_refused(tmp_path):
    gltf = Gltf()
    gltf.node(mesh=gltf.mesh(triangles=TRIANGLES + 2, colors=CORNER_COLORS, uv=None))
    with pytest.raises(InputError, match="a face names vertex 5 "):
        open_mesh(gltf.glb(tmp_path / "a.glb"))


@pytest.mark.parametrize(
    ("kind", "entry"),
    [
        ("bufferViews", lambda view: {"buffer": 0, "byteLength": 10_000}),
        (
            "accessors",
            lambda view: {"bufferView": view, "componentType": 5121, "type": "SCALAR", "count": 10_000},
        ),
    ],
)
def test_data_that_are_promised_many_times_are_refused(tmp_path, kind, entry):
    gltf = textured_gltf()
    view = gltf.view(bytes(10_000))
    gltf.tree[kind] += [entry(view)] * 5000
    with pytest.raises(InputError, match="bytes of data promised in"):
        open_mesh(gltf.glb(tmp_path / "a.glb"))


def test_deep_json_and_deep_nodes_are_refused(tmp_path):
    path = tmp_path / "a.gltf"
    path.write_text("[" * 200_000)
    with pytest.raises(InputError, match="broken JSON"):
        open_mesh(path)
    gltf = textured_gltf()
    for i in range(300):
        gltf.node(is_root=False, children=[i])
    gltf.tree["scenes"][0]["nodes"] = [300]
    with pytest.raises(InputError, match="over 200 nodes below each other"):
        open_mesh(gltf.glb(path))


@pytest.mark.parametrize("size", [4, 15, 30, 300, -1, -500])
def test_cut_glb_files_are_refused(tmp_path, size):
    path = textured_gltf().glb(tmp_path / "a.glb")
    path.write_bytes(path.read_bytes()[:size])
    _, message = read_or_refused(open_mesh, path)
    assert "wanted a whole glTF 2.0 mesh" in message


@pytest.mark.parametrize("text", [False, True])
def test_cut_ply_meshes_are_refused(tmp_path, text):
    path = write_ply(tmp_path / "a.ply", colors=CORNER_COLORS, options={"text": text})
    content = path.read_bytes()
    for size in (len(content) - 9, content.index(b"end_header") + 30):
        path.write_bytes(content[:size])
        _, message = read_or_refused(open_ply, path)
        assert message


def test_ply_colors_of_other_types_are_refused_in_meshes(tmp_path):
    path = write_ply(tmp_path / "a.ply", colors=CORNER_COLORS, options={"text": True})
    path.write_text(path.read_text().replace("uchar green", "ushort green"))
    with pytest.raises(InputError, match="'green' is of type u2, wanted uchar 0-255 or float 0-1 in a mesh"):
        open_ply(path)
