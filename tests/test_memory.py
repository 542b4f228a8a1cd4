"""What may be taken of the memory, and that it is asked before much is."""

import functools
import os
import resource
import tracemalloc

import av
import cv2
import numpy as np
import psutil
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base
from PIL.PngImagePlugin import PngImageFile
from refusals import assert_input_error
from rooms import AUTO, as_panorama, ask as ask_photo, query, room, scan_map, stream

from piccolo.cloud import octree, voxels as voxels_module
from piccolo.cloud.stream import stream_of_arrays
from piccolo.localization.search import search_poses
from piccolo.photo.panorama import read_panorama
from piccolo.photo.panorama.facts import read_photo_facts
from piccolo.photo.panorama.video import frames_of
from piccolo.scan_map.scan_map import prepare_map
from piccolo.system.errors import InputError
from piccolo.system.jobs import memory, threads
from piccolo.system.jobs.threads import Workers
from piccolo.views.candidate_views import SEARCH_VIEW, render_views, render_wide

TIER = "scene"


@pytest.fixture
def address_space():
    """Limit the address space to so many bytes, or to so many more than are taken, until the test ends."""
    limits = resource.getrlimit(resource.RLIMIT_AS)
    yield lambda most: resource.setrlimit(resource.RLIMIT_AS, (int(most), limits[1]))
    resource.setrlimit(resource.RLIMIT_AS, limits)


def test_default_is_a_part_of_what_is_free_and_a_limit_counts_what_is_taken(limiting):
    assert memory.share_free(8e9, 1e9, None) == pytest.approx(6.4e9)
    assert memory.share_free(8e9, 1e9, 3e9) == pytest.approx(2e9)
    assert memory.share_free(8e9, 1e9, 500e9) == pytest.approx(8e9)
    limiting(memory.memory_taken() / 1e9 + 0.2)
    assert memory.memory_left() == pytest.approx(2e8, rel=0.02)
    memory.check_memory(1.9e8, "a", "b")
    with pytest.raises(InputError, match=r"^the grid needs 0.21 GB of memory, 0.2 GB may be used; cut it"):
        memory.check_memory(2.1e8, "the grid", "cut it")
    for wrong in (0.0, -1.0, float("nan")):
        assert_input_error("`max_memory`: found", limiting, wrong)


def test_a_small_part_of_what_was_left_a_moment_ago_is_not_measured_again(limiting):
    limiting(memory.memory_taken() / 1e9 + 0.1)
    memory.check_memory(1e7, "a", "b")
    memory.LIMIT[:] = [1.0]  # [byte]
    memory.check_memory(1e6, "a", "b")
    with pytest.raises(InputError, match=r"^a needs 0.003 GB of memory, 0 GB may be used; b, or"):
        memory.check_memory(3e6, "a", "b")
    with pytest.raises(InputError, match=r"^a needs 0.001 GB"):
        memory.check_memory(1e6, "a", "b")


V1 = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
V2 = "memory.max", "memory.current", "inactive_file"


@pytest.mark.parametrize(
    ("line", "folder", "names"), [("0::/a/b", "a", V2), ("4:cpu,memory:/a", "memory/a", V1)]
)
def test_a_container_leaves_its_limit_less_what_is_used_but_for_caches(tmp_path, line, folder, names):
    own = tmp_path / "own"
    own.write_text(f"7:cpu:/a\n{line}\n")
    free = functools.partial(memory.free_of_cgroup, own, tmp_path / "cgroup")
    assert free() == float("inf")
    limit, usage, stat = (tmp_path / "cgroup" / folder / name for name in (*names[:2], "memory.stat"))
    limit.parent.mkdir(parents=True)
    limit.write_text("3000000000\n")
    usage.write_text("1500000000\n")
    stat.write_text(f"anon 5\n{names[2]} 500000000\n")
    assert free() == 2e9
    limit.write_text("max\n")
    assert free() == float("inf")


def test_address_space_is_a_limit_too(address_space):
    address_space(1e12)
    assert 0.0 < memory.free_of_process() < 1e12


def test_systems_without_a_limit_of_address_space_or_of_cores(monkeypatch):
    """As macOS."""
    monkeypatch.delattr(psutil, "RLIMIT_AS")
    assert memory.free_of_process() == float("inf")
    monkeypatch.setattr(threads, "this_process", object)
    assert 1 <= threads.num_cores() <= os.cpu_count()


def test_work_begins_only_where_errors_can_still_be_raised(address_space):
    cloud = stream_of_arrays(np.zeros((1000, 3)), np.arange(3000, dtype=np.uint8).reshape(1000, 3))
    address_space(memory.this_process().memory_info().vms + 1.9e8)
    with pytest.raises(MemoryError, match=r"^ulimit -v leaves 0.19 GB, wanted 0.2 or more"):
        cloud.read()
    with pytest.raises(MemoryError, match="ulimit"):
        list(Workers().map(abs, [1], "a"))
    address_space(memory.this_process().memory_info().vms + 5e8)
    assert list(Workers().map(abs, [-1], "a")) == [1]
    assert len(cloud.read().points) == 1000


def test_voxels_and_their_octree_take_what_they_say(monkeypatch):
    for module in (voxels_module, octree):
        monkeypatch.setattr(module, "VOXELS_AT_ONCE", 1 << 10)
    rng = np.random.default_rng(0)
    num = 200_000
    points = rng.uniform(0, 60, (num, 3))
    colors = rng.integers(0, 256, (num, 3), np.uint8)
    kernels_compiled = voxels_module.VoxelTable("a.ply")
    kernels_compiled.add(points[: num // 4], colors[: num // 4])
    kernels_compiled.finish()
    tracemalloc.start()
    try:
        table = voxels_module.VoxelTable("a.ply")
        table.add(points, colors)
        slots = 2 * voxels_module.SLOT_BYTES / voxels_module.MAX_LOAD
        at_most = voxels_module.ROW_BYTES * (1 + 1 / voxels_module.MORE_ROWS) + slots
        assert tracemalloc.get_traced_memory()[1] < 1.05 * num * at_most + 1e6
        tracemalloc.reset_peak()
        voxels = table.finish()
        at_most = voxels_module.ROW_BYTES * (1 + 1 / voxels_module.MORE_ROWS) + voxels_module.SORTED_BYTES
        assert tracemalloc.get_traced_memory()[1] < 1.05 * num * at_most + 1e6
        assert tracemalloc.get_traced_memory()[0] < 1.05 * num * (8 + 24)
        asked, before, peaks = [], [], []

        def ask(num_bytes, *_):
            peaks.append(tracemalloc.get_traced_memory()[1])
            asked.append(num_bytes)
            before.append(tracemalloc.get_traced_memory()[0])
            tracemalloc.reset_peak()

        monkeypatch.setattr(octree, "check_memory", ask)
        octree.build_octree(voxels)
        ask(0)
    finally:
        tracemalloc.stop()
    assert asked[0] == len(voxels.nodes) * octree.LEVEL_BYTES
    for num_bytes, at_first, peak in zip(asked[:-1], before[:-1], peaks[1:], strict=True):
        assert peak - at_first < 1.02 * num_bytes + 1e5


def test_what_libraries_raise_when_memory_is_short(address_space):
    opencv = type("error", (Exception,), {"code": -4})
    for error in (MemoryError(), RuntimeError("can't start new thread"), opencv()):
        assert memory.is_shortage(error)
    assert not memory.is_shortage(RuntimeError("other"))
    for most, is_one in ((1e12, True), (resource.RLIM_INFINITY, False)):  # C code that gives up
        address_space(most)
        assert memory.is_shortage(SystemError("error return without exception set")) == is_one
        assert not memory.is_shortage(SystemError("other"))


def test_all_that_grows_asks_first(limiting, tmp_path):
    picture = tmp_path / "a.png"
    whole = scan_map(1)
    taken = as_panorama(query(1).rgb)
    cv2.imwrite(str(picture), taken.rgb)
    rng = np.random.default_rng(0)
    table = voxels_module.VoxelTable("a.ply")
    workers = Workers(1)
    asked = ask_photo(taken, whole)
    limiting(1e-6)
    spread = rng.uniform(0, 90, (50_000, 3))
    colors = np.full((50_000, 3), 9, np.uint8)
    for text, ask in (
        ("a.png: found 512 x 256, which needs 0.0016 GB", lambda: read_panorama(picture)),
        ("a.ply: a table of more than 32768 voxels", lambda: table.add(spread, colors)),
        ("voxels of 2 cm needs", lambda: prepare_map(stream(room(1)[1]), workers)),
        ("prepared views", lambda: render_wide(whole.octree, whole.centers, SEARCH_VIEW, workers)),
        ("[0-9] views needs", lambda: render_views(whole.octree, whole.centers, SEARCH_VIEW, workers)),
        ("rotations needs .*num_yaws", lambda: search_poses(asked, "known", AUTO.effort, workers)),
    ):
        assert_input_error(text, ask)


def test_frames_of_a_video_are_asked_for_before_one_is_decoded(limiting, tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=1)
        stream.width, stream.height, stream.pix_fmt = 256, 128, "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.zeros((128, 256, 3), np.uint8), "rgb24")
        for packet in (*stream.encode(frame), *stream.encode()):
            container.mux(packet)
    assert len(list(frames_of(path, 1.0, tmp_path))) == 1
    limiting(1e-5)
    with pytest.raises(InputError, match=r"a.mp4: frames of 256 x 128 needs? .* make the video smaller"):
        next(frames_of(path, 1.0, tmp_path))


@pytest.mark.parametrize("is_behind", [False, True])
def test_the_file_of_a_photo_tells_of_it_without_being_decoded(tmp_path, monkeypatch, is_behind):
    exif = Image.Exif()
    exif[IFD.Exif] = {Base.DateTimeOriginal: "2024:05:06 07:08:09"}
    path = tmp_path / "a.png"
    Image.new("RGB", (256, 128)).save(path, exif=exif)
    content = path.read_bytes()
    begin = content.index(b"eXIf") - 4
    end = begin + 12 + int.from_bytes(content[begin : begin + 4])
    if is_behind:
        path.write_bytes(content[:begin] + content[end:-12] + content[begin:end] + content[-12:])
    monkeypatch.setattr(PngImageFile, "load", lambda *_: pytest.fail("decoded"))
    assert read_photo_facts(path).capture_time == "2024-05-06T07:08:09"
