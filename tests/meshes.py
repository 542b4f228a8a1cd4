"""Made-up meshes, written by hand."""

import base64
import json
import struct
from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement

RED, GREEN, BLUE, YELLOW = (250, 10, 10), (10, 250, 10), (10, 10, 250), (250, 250, 10)
QUADRANTS = np.array([[RED, GREEN], [BLUE, YELLOW]], np.uint8).repeat(4, axis=0).repeat(4, axis=1)
CORNER_COLORS = np.array([[0, 0, 40], [255, 0, 40], [255, 255, 40], [0, 255, 40]], np.uint8)  # of SQUARE
CORNERS = {RED: (0, 1), GREEN: (1, 1), BLUE: (0, 0), YELLOW: (1, 0)}  # of the square's x and y
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
UV_FROM_BELOW = SQUARE[:, :2]  # v upwards, as in OBJ
UV_FROM_ABOVE = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # v downwards, as in glTF


def png(pixels=QUADRANTS, **options):
    file = BytesIO()
    Image.fromarray(pixels).save(file, options.pop("format", "PNG"), **options)
    return file.getvalue()


def obj_text(vertices=SQUARE, uv=UV_FROM_BELOW, triangles=TRIANGLES, library="room.mtl", material="wall"):
    lines = [f"mtllib {library}"] if library else []
    lines += ["v " + " ".join(map(str, row)) for row in vertices.tolist()]
    lines += ["vt " + " ".join(map(str, row)) for row in uv.tolist()] if uv is not None else []
    lines += [f"usemtl {material}"] if material else []
    corner = "{0}/{0}" if uv is not None else "{0}"
    lines += ["f " + " ".join(corner.format(i + 1) for i in row) for row in triangles.tolist()]
    return "\n".join(lines) + "\n"


def write_obj(folder, texture=None, mtl="newmtl wall\nmap_Kd wall.png\n", **options):
    (folder / "wall.png").write_bytes(png() if texture is None else texture)
    if mtl:
        (folder / "room.mtl").write_text(mtl)
    path = folder / "room.obj"
    path.write_text(obj_text(**options))
    return path


class Gltf:
    def __init__(self):
        self.data = b""
        self.tree = {
            "asset": {"version": "2.0"},
            "bufferViews": [],
            "accessors": [],
            "materials": [],
            "meshes": [],
            "nodes": [],
            "scenes": [{"nodes": []}],
        }

    def view(self, content):
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.tree["bufferViews"].append(view)
        self.data += content
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, array):
        kind = {"f": 5126, "I": 5125, "B": 5121, "H": 5123}[array.dtype.char]
        shape = {1: "SCALAR"}.get(array.ndim) or f"VEC{array.shape[1]}"
        row = {"bufferView": self.view(array.tobytes()), "componentType": kind}
        row |= {"type": shape, "count": len(array)}
        if kind in (5121, 5123) and array.ndim > 1:
            row["normalized"] = True
        self.tree["accessors"].append(row)
        return len(self.tree["accessors"]) - 1

    def material(self, texture=None, factor=None):
        base = {} if factor is None else {"baseColorFactor": [*factor, 1.0]}
        if texture is not None:
            images = self.tree.setdefault("images", [])
            images.append({"bufferView": self.view(texture), "mimeType": "image/png"})
            self.tree.setdefault("textures", []).append({"source": len(images) - 1})
            base["baseColorTexture"] = {"index": len(images) - 1}
        self.tree["materials"].append({"pbrMetallicRoughness": base})
        return len(self.tree["materials"]) - 1

    def mesh(self, vertices=SQUARE, uv=UV_FROM_ABOVE, colors=None, triangles=TRIANGLES, material=None):
        attributes = {"POSITION": self.accessor(vertices.astype(np.float32))}
        if uv is not None:
            attributes["TEXCOORD_0"] = self.accessor(uv.astype(np.float32))
        if colors is not None:
            attributes["COLOR_0"] = self.accessor(colors)
        indices = self.accessor(triangles.astype(np.uint32).reshape(-1))
        primitive = {"attributes": attributes, "indices": indices}
        if material is not None:
            primitive["material"] = material
        self.tree["meshes"].append({"primitives": [primitive]})
        return len(self.tree["meshes"]) - 1

    def node(self, is_root=True, **options):
        self.tree["nodes"].append(options)
        row = len(self.tree["nodes"]) - 1
        if is_root:
            self.tree["scenes"][0]["nodes"].append(row)
        return row

    def glb(self, path):
        tree = {**self.tree, "buffers": [{"byteLength": len(self.data)}]}
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + b"\0" * (-len(self.data) % 4)
        size = 12 + 8 + len(text) + 8 + len(data)
        parts = [struct.pack("<4sIII4s", b"glTF", 2, size, len(text), b"JSON"), text]
        path.write_bytes(b"".join([*parts, struct.pack("<I4s", len(data), b"BIN\0"), data]))
        return path

    def gltf(self, path, uri=None, is_written=True):
        """Beside its buffer, or with it inside."""
        inside = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        tree = {**self.tree, "buffers": [{"byteLength": len(self.data), "uri": uri or inside}]}
        path.write_text(json.dumps(tree))
        if uri and is_written:
            (path.parent / uri).write_bytes(self.data)
        return path


def textured_gltf(texture=None, **node):
    gltf = Gltf()
    gltf.node(mesh=gltf.mesh(material=gltf.material(png() if texture is None else texture)), **node)
    return gltf


def write_ply(path, vertices=SQUARE, colors=None, face_colors=None, uv=None, options=None):
    """A PLY file of the square's two triangles; `options` go to plyfile."""
    fields = [(name, "f4") for name in "xyz"]
    channels = [(name, "u1") for name in ("red", "green", "blue")]
    fields += channels if colors is not None else []
    fields += [("s", "f4"), ("t", "f4")] if uv is not None else []
    columns = [*vertices.T, *([] if colors is None else colors.T), *([] if uv is None else uv.T)]
    vertex = np.array(list(zip(*columns, strict=True)), dtype=fields)
    face_fields = [("vertex_indices", "i4", (3,)), *(channels if face_colors is not None else [])]
    faces = np.zeros(len(TRIANGLES), dtype=face_fields)
    faces["vertex_indices"] = TRIANGLES
    for i, (name, _) in enumerate(channels if face_colors is not None else []):
        faces[name] = face_colors[:, i]
    elements = [PlyElement.describe(vertex, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, **(options or {})).write(str(path))
    return path


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


def write_wedges(path, textures=(), colors=None, kind="uchar"):
    """A PLY file with texture coordinates a face corner."""
    names = () if colors is None else ("red", "green", "blue")
    properties = "".join(f"property {kind} {name}\n" for name in names)
    comments = "".join(f"comment TextureFile {name}\n" for name in textures)
    head = PLY_HEAD.format(comments=comments, colors=properties)
    rows = SQUARE if colors is None else np.concatenate([SQUARE, colors], axis=1)
    path.write_text(head + "".join(" ".join(f"{n:g}" for n in row) + "\n" for row in rows.tolist()) + WEDGES)
    return path


def assert_quadrants(raw, tolerance=0):
    """Each quadrant of the texture lies on its own corner of the square."""
    assert len(raw.colors) == 10_000
    is_clear = np.all(np.abs(raw.points_world[:, :2] - 0.5) > 1e-6, axis=1)  # of the borders within
    raw = type(raw)(raw.points_world[is_clear], raw.colors[is_clear])
    quadrant = (raw.points_world[:, :2] > 0.5).astype(int)
    for color, corner in CORNERS.items():
        found = raw.colors[np.all(quadrant == corner, axis=1)].astype(int)
        assert len(found) == pytest.approx(2500, rel=0.02)
        np.testing.assert_allclose(found, np.broadcast_to(color, found.shape), atol=tolerance)


def change(path, value):
    """A change of glTF's JSON: the entry at `path` becomes `value`, or goes if that is None."""

    def apply(tree):
        *way, last = path
        for key in way:
            tree = tree[key]
        if value is None:
            del tree[last]
        else:
            tree[last] = value

    return apply
