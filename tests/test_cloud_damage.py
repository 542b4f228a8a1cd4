"""Files of points and meshes that are damaged, cut off or hostile: read, or refused in one line."""

import io
import struct
import sys
import zlib

import meshes as made
import numpy as np
import pytest
from clouds import read, whole
from hypothesis import given, settings, strategies as st
from las_files import RAW, las_bytes, laz_bytes
from meshes import CORNER_COLORS, SQUARE, Gltf, obj_text, textured_gltf, write_obj, write_ply
from pcd_files import COLORS, ENCODINGS, content_of
from ply_files import vertices
from plyfile import PlyData
from refusals import assert_input_error, assert_refused, mutated, read_or_refused
from scans import read_cloud
from text_files import TWO_SCANS, lines_of, pts

from piccolo.cloud.readers.mesh import open_mesh
from piccolo.cloud.readers.reader import RawCloud
from piccolo.cloud.stream import open_cloud, open_source

SMALL = RawCloud(RAW.points_world[:60], RAW.colors[:60])
PAIR = {"points": RAW.points_world, "colors": RAW.colors}


def written(write, *arguments, **options):
    file = io.BytesIO()
    write(file, *arguments, **options)
    return file.getvalue()


def ply(**options):
    return written(PlyData([vertices()], **options).write)


CONTENTS = {
    "a.las": las_bytes(SMALL, 3),
    **{f"{f}.laz": laz_bytes(las_bytes(SMALL, f, extra_bytes=1), 25) for f in (2, 5, 7, 10)},
    **{f"{f} of any size.laz": laz_bytes(las_bytes(SMALL, f), cuts=(1, 40)) for f in (3, 8)},
    **{f"{encoding}.pcd": content_of(COLORS["uint rgb"], encoding) for encoding in ENCODINGS},
    "binary.ply": ply(byte_order=">"),
    "text.ply": ply(text=True),
    "a.npy": written(np.save, np.hstack([RAW.points_world, RAW.colors])),
    "a.npz": written(np.savez, **PAIR),
    "packed.npz": written(np.savez_compressed, **PAIR),
    "a.ptx": "\n".join(TWO_SCANS).encode(),
    "a.pts": "\n".join(["600", *pts()[:600], "600", *pts()[600:]]).encode(),
    "a.txt": "\n".join(lines_of(RAW)).encode(),
}


@pytest.mark.parametrize("name", CONTENTS)
@settings(max_examples=50)
@given(data=st.data())
def test_mutated_files_are_read_or_refused(name, data, tmp_path_factory):
    content = CONTENTS[name]
    cut = data.draw(st.sampled_from([120, 300, len(content) // 2]))
    head = mutated(data.draw, st.integers, content[:cut])
    path = tmp_path_factory.getbasetemp() / f"mutated {name}"
    path.write_bytes(head + mutated(data.draw, st.integers, content[cut:]))
    if path.stat().st_size <= 8:  # a text of one line, perhaps
        return
    result, message = read_or_refused(read, path)
    assert (result is None) == bool(message)
    if result is not None:
        points, colors = result
        assert points.shape == colors.shape
        assert (points.dtype.kind, colors.dtype) == ("f", np.uint8)


@pytest.mark.parametrize(
    ("name", "message"), [("a.las", "the file was cut while it was read"), ("7.laz", "cut off or broken")]
)
def test_a_file_cut_while_it_is_read_is_refused(tmp_path, name, message):
    path = tmp_path / name
    path.write_bytes(CONTENTS[name])
    source = open_source(path)
    path.write_bytes(CONTENTS[name][:-300])
    assert_refused(message, lambda _: list(source.read_chunks()), path)


def refusal(path, read=read_cloud):
    _, message = read_or_refused(read, path)
    assert message
    return message


@pytest.mark.parametrize("name", ["gone.png", "../gone.png", "a" * 5000])
def test_missing_files_are_named(tmp_path, name):
    gltf = made.textured_gltf()
    gltf.tree["images"] = [{"uri": name}]
    paths = [
        gltf.glb(tmp_path / "a.glb"),
        made.textured_gltf().gltf(tmp_path / "a.gltf", name, is_written=False),
        made.write_ply(
            tmp_path / "a.ply", uv=made.UV_FROM_BELOW, options={"comments": [f"TextureFile {name}"]}
        ),
    ]
    for path in paths:
        assert f"names the file {name[:100]!a}" in refusal(path)
    obj = open_source(made.write_obj(tmp_path, mtl=f"newmtl wall\nmap_Kd {name}\n"))
    assert obj.channel == "shape"
    assert f"names the file {name[:100]!a}" in obj.warnings[0]
    (tmp_path / "room.mtl").unlink()
    bare = open_source(made.write_obj(tmp_path, mtl=""))
    assert "names the file 'room.mtl', which is not in its" in bare.warnings[0]


NAMES = [
    "C:\\scans\\wall.png",
    "https://example.com/wall.png",
    "/home/me/wall.png",
    "WALL.PNG",
    "-s 1 1 1 wall.png",
    "-clamp on wall.png",
]


@pytest.mark.parametrize("name", NAMES)
def test_the_file_of_that_name_beside_an_obj_is_taken(tmp_path, name):
    expected = whole(open_source, made.write_obj(tmp_path))
    found = open_source(made.write_obj(tmp_path, mtl=f"newmtl wall\nmap_Kd {name}\n"))
    assert (found.channel, found.warnings) == ("colors", ())
    chunks = list(found.read_chunks())
    np.testing.assert_array_equal(np.vstack([chunk.colors for chunk in chunks]), expected.colors)


def test_vertex_colors_stand_in_for_missing_materials(tmp_path):
    vertices = np.concatenate([made.SQUARE, made.CORNER_COLORS / 255.0], axis=1)
    path = tmp_path / "a.obj"
    path.write_text(made.obj_text(vertices, None, library="gone.mtl", material=""))
    source = open_source(path)
    assert source.channel == "colors"
    assert (
        "names the file 'gone.mtl', which is not in its folder; its colours are missing" in source.warnings[0]
    )


def test_a_texture_that_says_it_is_huge_is_refused(tmp_path):
    texture = bytearray(made.png())
    texture[16:24] = struct.pack(">II", 40_000, 40_000)
    texture[29:33] = struct.pack(">I", zlib.crc32(texture[12:29]))
    options = {"comments": ["TextureFile wall.png"]}
    ply = made.write_ply(tmp_path / "a.ply", uv=made.UV_FROM_BELOW, options=options)
    glb = made.textured_gltf(bytes(texture)).glb(tmp_path / "a.glb")
    for mesh in (made.write_obj(tmp_path, texture=texture), ply, glb):
        assert "a texture of 40000 x 40000 texels, wanted at most 268435456" in refusal(mesh)


@pytest.mark.parametrize("cut", [20, 60, -30])
def test_broken_textures_are_refused(tmp_path, cut):
    noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), np.uint8)
    texture = made.png(noise)[:cut]
    glb = made.textured_gltf(texture).glb(tmp_path / "a.glb")
    for path in (made.write_obj(tmp_path, texture=texture), glb):
        assert "can't be read" in refusal(path)


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    path = made.textured_gltf().glb(tmp_path / "a.glb")
    monkeypatch.setitem(sys.modules, "trimesh", None)
    assert_input_error(r"needs trimesh.*in a checkout '\.\[formats\]'", open_cloud, [path])


@pytest.mark.parametrize(
    "face", ["1/1 2/2 9/3", "-1/1 -2/2 -3/3", "0/1 1/1 2/2", "1/1 2/0 3/3", f"1/1 2/2 {10**11}/3"]
)
def test_wrong_indices_in_obj_are_refused(tmp_path, face):
    path = made.write_obj(tmp_path)
    path.write_text(path.read_text() + f"f {face}" + "\n")
    refusal(path, open_mesh)


@pytest.mark.parametrize(
    "text", ["", "# nothing\n", "v 0 0 0\n", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2\n", "f 1 2 3\n"]
)
def test_empty_meshes_are_refused(tmp_path, text):
    path = tmp_path / "a.obj"
    path.write_text(text)
    refusal(path)


def test_float_colors_out_of_range_are_refused_not_cut_off(tmp_path):
    colors = made.CORNER_COLORS * 3.0
    obj = tmp_path / "a.obj"
    vertices = np.concatenate([made.SQUARE, colors], axis=1)
    obj.write_text(made.obj_text(vertices, None, library="", material=""))
    ply = made.write_wedges(tmp_path / "a.ply", colors=colors, kind="float")
    assert "a colour of 765, wanted 0 to 255" in refusal(obj)
    assert "a colour of 765, wanted 0 to 255" in refusal(ply)


def test_several_textures_of_a_ply_are_refused(tmp_path):
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(made.png())
    path = made.write_wedges(tmp_path / "a.ply", textures=("a.png", "b.png"))
    assert "names 2 textures, wanted one" in refusal(path)


PRIMITIVE = ("meshes", 0, "primitives", 0)
BASE = ("materials", 0, "pbrMetallicRoughness")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("accessors", 0, "count"), 10**12),
        (("accessors", 0, "byteOffset"), 8),
        (("accessors", 0, "componentType"), 5123),
        (("accessors", 0, "bufferView"), None),
        (("accessors", 0, "sparse"), {"count": 1}),
        (("bufferViews", 0, "byteLength"), 10**9),
        (("bufferViews", 1, "byteStride"), 0),
        (("bufferViews", 0, "buffer"), 7),
        (("nodes", 0, "children"), [0]),
        (("scenes", 0, "nodes"), []),
        (("nodes", 0, "mesh"), 3),
        (("nodes", 0, "scale"), [0, 0, 0]),
        ((*PRIMITIVE, "mode"), 6),
        ((*PRIMITIVE, "material"), 1),
        ((*PRIMITIVE, "attributes", "TEXCOORD_0"), None),
        ((*BASE, "baseColorTexture", "texCoord"), 1),
        ((*BASE, "baseColorTexture", "index"), 4),
        ((*BASE, "baseColorTexture", "extensions"), {"KHR_texture_transform": {}}),
        (("materials", 0, "extensions"), {"KHR_materials_pbrSpecularGlossiness": {}}),
        (("extensionsRequired",), ["KHR_draco_mesh_compression"]),
        (("asset", "version"), "1.0"),
        (("asset",), None),
        (("meshes",), 5),
    ],
)
def test_broken_gltf_is_refused(tmp_path, path, value):
    gltf = made.textured_gltf()
    made.change(path, value)(gltf.tree)
    message = refusal(gltf.glb(tmp_path / "a.glb"), open_mesh)
    assert path != ("extensionsRequired",) or f"requires the extensions {value[0]!r}, wanted" in message


def test_gltf_with_wrong_indices_says_so(tmp_path):
    gltf = made.Gltf()
    gltf.node(mesh=gltf.mesh(triangles=made.TRIANGLES + 2, colors=made.CORNER_COLORS, uv=None))
    assert "a face names vertex 5 " in refusal(gltf.glb(tmp_path / "a.glb"))


@pytest.mark.parametrize("size", [4, 15, 30, 300, -1, -500])
def test_cut_glb_files_are_refused(tmp_path, size):
    path = made.textured_gltf().glb(tmp_path / "a.glb")
    path.write_bytes(path.read_bytes()[:size])
    assert "wanted a whole glTF 2.0 mesh" in refusal(path)


def test_cut_gltf_buffers_are_refused(tmp_path):
    path = made.textured_gltf().gltf(tmp_path / "a.gltf", "a b.bin")
    content = (tmp_path / "a b.bin").read_bytes()
    (tmp_path / "a b.bin").write_bytes(content[:-1])
    assert f"the buffer 'a b.bin' has {len(content) - 1} of {len(content)} bytes" in refusal(path)


def write_colored_obj(folder):
    path = folder / "colored.obj"
    vertices = np.concatenate([SQUARE, CORNER_COLORS / 255], axis=1)
    path.write_text(obj_text(vertices, None, library="", material=""))
    return path


def write_colored_glb(folder):
    colored = Gltf()
    colored.node(mesh=colored.mesh(uv=None, colors=CORNER_COLORS), rotation=[0.5, 0.5, 0.5, 0.5])
    return colored.glb(folder / "colored.glb")


MESHES = {
    "textured.obj": write_obj,
    "colored.obj": write_colored_obj,
    "textured.glb": lambda folder: textured_gltf().glb(folder / "a.glb"),
    "colored.glb": write_colored_glb,
    "textured.gltf": lambda folder: textured_gltf().gltf(folder / "a.gltf"),
    "binary.ply": lambda folder: write_ply(folder / "a.ply", colors=CORNER_COLORS),
    "text.ply": lambda folder: write_ply(folder / "a.ply", colors=CORNER_COLORS, options={"text": True}),
}


@pytest.fixture(scope="module")
def few_points():
    """Few points of a mesh that a flipped bit has made huge."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("piccolo.cloud.readers.mesh.MAX_MESH_POINTS", 20_000)
        yield


@pytest.mark.usefixtures("few_points")
@pytest.mark.parametrize("name", MESHES)
@settings(max_examples=40, derandomize=True)
@given(data=st.data())
def test_mutated_meshes_raise_nothing_but_input_error(name, data, tmp_path_factory):
    path = MESHES[name](tmp_path_factory.getbasetemp())
    path.write_bytes(mutated(data.draw, st.integers, path.read_bytes()))
    cloud, message = read_or_refused(read_cloud, path)
    assert message or len(cloud.points) >= 1000
