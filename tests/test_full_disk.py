"""Where a disk is full nothing is half written, whichever library writes; a limit of files stands for it."""

import ast
import errno
import re
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import rooms
from poses import CENTER, result, tilted_poses, write_results
from refusals import small_files

from piccolo.apps.export import export_poses
from piccolo.apps.export.colmap import write_model
from piccolo.apps.export.formats import export
from piccolo.apps.export.posed_images import Options
from piccolo.cloud.stream import open_cloud
from piccolo.cloud.writers import vertex_rows, write_colored
from piccolo.photo.panorama.video import frames_at
from piccolo.system.errors import import_optional, text_of
from piccolo.system.files import atomic
from research.synthetic.walk_frames import writing_video
from research.synthetic.world import Photo, write_photo

PACKAGES = [Path(__file__).resolve().parents[1] / name for name in ("piccolo", "research")]
# what a library's objects write by a file's name, and Python's own without a name in the error
WRITERS = {"imwrite", "imsave", "saveas", "save_all", "tofile", "savetxt", "write_bytes", "write_text"}
NOISE = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
TRUNCATED = pytest.mark.parametrize("limit", [0, 100, 5000])


def _files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def _assert_refused(out, write, limit=5000):
    """`write` fails in a line that names `out`, or a temporary folder, whose disk may be the full one."""
    before = _files(out.parent)
    with small_files(limit), pytest.raises(OSError, match="File too large") as error:
        write()
    assert error.value.errno == errno.EFBIG
    line = text_of(error.value)
    assert line.endswith(": cannot be used (File too large)")
    assert str(out) in line or atomic.PREFIX in line
    del error  # whose traceback keeps what the library has opened
    assert _files(out.parent) == before


def _model(num_points):
    model = pycolmap.Reconstruction()
    for xyz in np.random.default_rng(1).normal(size=(num_points, 3)):
        model.add_point3D(xyz, pycolmap.Track(), np.uint8([1, 2, 3]))
    return model


@pytest.mark.parametrize("num_points", [0, 500])
def test_a_model_is_whole_or_not_there(tmp_path, num_points, capfd):
    """Its files, of up to 35 KB, are cut at each of their parts; one byte more is enough."""
    model = _model(num_points)
    write_model(model, tmp_path / "whole")
    sizes = sorted({path.stat().st_size for path in (tmp_path / "whole").iterdir()})
    for limit in {0, 100, *(size - 1 for size in sizes)}:
        finished = []
        with small_files(limit), pytest.raises(OSError, match="File too large") as error:
            write_model(model, tmp_path / "cut", lambda: finished.append(1))  # noqa: B023
        assert error.value.filename == str(tmp_path / "cut")
        assert finished == []
    assert [path.name for path in tmp_path.iterdir()] == ["whole"]
    with small_files(sizes[-1] + atomic.ROOM):
        write_model(model, tmp_path / "again")
    assert _files(tmp_path / "again") == _files(tmp_path / "whole")
    assert capfd.readouterr() == ("", "")


def test_a_model_that_lacks_something_is_not_written(tmp_path, monkeypatch):
    """As a library might leave it that fails for another reason, and says nothing."""
    short = _model(3)
    model = _model(4)
    monkeypatch.setattr(type(model), "write", lambda _, folder: short.write_binary(folder))
    with pytest.raises(OSError, match="less was written than the model holds") as error:
        write_model(model, tmp_path / "out")
    assert error.value.filename == str(tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("limit", [0, 200])
@pytest.mark.parametrize("form", ["colmap", "csv", "kitti", "opensfm", "potree"])
def test_the_command_says_so_and_old_files_stay(tmp_path, form, limit, capsys):
    results = [result(f"{k}.jpg", pose) for k, pose in enumerate(tilted_poses(30))]
    poses = write_results(tmp_path / "r.jsonl", results)
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "a.offset.txt").write_text("old")
    if form != "colmap":
        (folder / "a").write_text("old")
    before = _files(folder)
    words = ["--results", str(poses), "--format", form, "--out", str(folder / "a")]
    words += ["--offset", "500000", "5400000", "300"]
    words += ["--size", "512", "256"] if form in ("colmap", "opensfm") else []
    with small_files(limit):
        assert export_poses.main(words) == 3
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"export_poses.py: {folder / 'a'}: cannot be used (File too large)\n")
    assert _files(folder) == before
    assert len(list(folder.iterdir())) == len(before)


@TRUNCATED
@pytest.mark.parametrize("suffix", [".ply", ".las", ".laz", ".e57"])
def test_clouds(tmp_path, suffix, limit, capfd):
    points = np.random.default_rng(4).uniform(0, 9, (3000, 3))
    rooms.write_ply(tmp_path / "cloud.ply", vertex_rows(points, np.full((3000, 3), 9, np.uint8)))
    out = tmp_path / f"out{suffix}"
    out.write_bytes(b"old")
    colors = np.uint8(points * 20), np.ones(3000, np.uint8)
    box = np.array([[0.0] * 3, [9.0] * 3])
    _assert_refused(
        out, lambda: write_colored(open_cloud([tmp_path / "cloud.ply"]), lambda _: colors, box, out), limit
    )
    assert capfd.readouterr() == ("", "")


def test_a_library_that_gives_no_reason_is_quoted_in_one_line(tmp_path):
    e57 = import_optional("this", "pye57.libe57").E57Exception
    with pytest.raises(OSError, match="the cable fell out") as error, atomic.library_writing(tmp_path, e57):
        raise e57("the cable\nfell out")
    assert text_of(error.value) == f"{tmp_path}: cannot be used (the cable fell out)"


@TRUNCATED
def test_recordings(tmp_path, limit):
    (tmp_path / "a.rrd").write_bytes(b"old")
    shown = [result(tmp_path / "0.jpg", pose) for pose in tilted_poses(1)]
    options = Options(size=(512, 256), offset=tuple(CENTER))
    _assert_refused(
        tmp_path / "a.rrd", lambda: export(shown, "rerun", tmp_path / "a.rrd", options), min(limit, 100)
    )


@TRUNCATED
def test_videos_photos_and_frames(tmp_path, limit):
    video, photo = tmp_path / "a.mp4", tmp_path / "a.jpg"

    def write():
        with writing_video(video, 5.0, (640, 480)) as add:
            for _ in range(3):
                add(NOISE)

    write()
    assert len(frames_at(video, [0.2], tmp_path) and [*frames_at(video, [0.2], tmp_path)]) == 1
    (tmp_path / "a_00000200.jpg").unlink()
    _assert_refused(video, write, limit)
    _assert_refused(photo, lambda: write_photo(Photo(NOISE, tilted_poses(1)[0], 500.0), photo), limit)
    frames = tmp_path / "frames"
    frames.mkdir()
    with small_files(limit), pytest.raises(OSError, match="File too large") as error:
        list(frames_at(video, [0.2], frames))
    assert error.value.filename == str(frames / "a_00000200.jpg")


def test_nothing_is_written_past_the_module_that_knows_of_full_disks():
    found = [
        f"{path.relative_to(folder)}: {node.func.attr}"
        for folder in PACKAGES
        for path in sorted(folder.rglob("*.py"))
        if path != Path(atomic.__file__)
        if not WRITERS.isdisjoint(re.findall(r"\w+", path.read_text()))  # others are not worth parsing
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in WRITERS
    ]
    # within `library_writing`
    assert found == ["apps/export/colmap.py: write_text"]
