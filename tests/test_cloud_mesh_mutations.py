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
        patch.setattr("piccolo.cloud.readers.mesh.MAX_POINTS", 20_000)
        yield


@pytest.mark.usefixtures("few_points")
@pytest.mark.parametrize("name", MESHES)
@settings(deadline=None, max_examples=40, derandomize=True)
@given(data=st.data())
def test_mutated_meshes_raise_nothing_but_input_error(name, data, tmp_path_factory):
    path = MESHES[name](tmp_path_factory.getbasetemp())
    path.write_bytes(mutated(data.draw, st.integers, path.read_bytes()))
    cloud, message = read_or_refused(read_cloud, path)
    assert message or len(cloud.points) >= 1000


def test_one_changed_number_of_the_json(tmp_path):
    """Every entry of the JSON in turn becomes something else."""

    def entries(part, path=()):
        for key, entry in list(part.items() if isinstance(part, dict) else enumerate(part)):
            yield (*path, key)
            if isinstance(entry, dict | list):
                yield from entries(entry, (*path, key))

    refusals = 0
    for way in entries(json.loads(json.dumps(textured_gltf().tree))):
        for value in (None, -1, 3, 10**20, 1.5, "x", [], {}, [[0]], True):
            gltf = textured_gltf()
            change(way, value)(gltf.tree)
            _, message = read_or_refused(open_mesh, gltf.glb(tmp_path / "a.glb"))
            refusals += bool(message)
    assert refusals > 200
