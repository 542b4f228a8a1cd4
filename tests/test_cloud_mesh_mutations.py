"""Meshes with bytes changed at random: nothing but InputError comes of them."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import CORNER_COLORS, SQUARE, Gltf, change, obj_text, textured_gltf, write_obj, write_ply
from refusals import mutated, read_or_refused

from piccolo.cloud import read_cloud
from piccolo.cloud.readers.mesh import open_mesh


def contents(folder):
    """A mesh of each format, with the texture of the OBJ file beside them."""
    vertices = np.concatenate([SQUARE, CORNER_COLORS / 255], axis=1)
    colored = Gltf()
    colored.node(mesh=colored.mesh(uv=None, colors=CORNER_COLORS), rotation=[0.5, 0.5, 0.5, 0.5])
    text = obj_text(vertices, None, library="", material="")
    return {
        "textured.obj": write_obj(folder).read_bytes(),
        "colored.obj": text.encode(),
        "textured.glb": textured_gltf().glb(folder / "a.glb").read_bytes(),
        "colored.glb": colored.glb(folder / "a.glb").read_bytes(),
        "textured.gltf": textured_gltf().gltf(folder / "a.gltf").read_bytes(),
        "binary.ply": write_ply(folder / "a.ply", colors=CORNER_COLORS).read_bytes(),
        "text.ply": write_ply(folder / "a.ply", colors=CORNER_COLORS, options={"text": True}).read_bytes(),
    }


NAMES = [
    "textured.obj",
    "colored.obj",
    "textured.glb",
    "colored.glb",
    "textured.gltf",
    "binary.ply",
    "text.ply",
]


@pytest.mark.parametrize("name", NAMES)
@settings(deadline=None, max_examples=40, derandomize=True)
@given(data=st.data())
def test_mutated_meshes_raise_nothing_but_input_error(name, data, tmp_path_factory, monkeypatch_small):
    folder = tmp_path_factory.getbasetemp()
    content = contents(folder)[name]
    path = folder / name
    path.write_bytes(mutated(data.draw, st.integers, content))
    cloud, message = read_or_refused(read_cloud, path)
    assert message or len(cloud.points) >= 1000


@pytest.fixture(scope="module")
def monkeypatch_small():
    """Few points of a mesh that a flipped bit has made huge."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("piccolo.cloud.readers.mesh.MAX_POINTS", 20_000)
        yield


def test_one_changed_number_of_the_json(tmp_path):
    """Every entry of the JSON in turn becomes something else."""
    tree = json.dumps(textured_gltf().tree)
    values = (None, -1, 3, 10**20, 1.5, "x", [], {}, [[0]], True)

    def entries(part, path=()):
        for key, entry in list(part.items() if isinstance(part, dict) else enumerate(part)):
            yield (*path, key)
            if isinstance(entry, dict | list):
                yield from entries(entry, (*path, key))

    refusals = 0
    for way in entries(json.loads(tree)):
        for value in values:
            gltf = textured_gltf()
            change(way, value)(gltf.tree)
            _, message = read_or_refused(open_mesh, gltf.glb(tmp_path / "a.glb"))
            refusals += bool(message)
    assert refusals > 200
