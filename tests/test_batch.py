"""Batches: what is named, what is written, and how a stopped one goes on."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from rooms import write_room

from piccolo.batch import localizer as module
from piccolo.batch.inputs import panoramas_of
from piccolo.cli import localize
from piccolo.errors import InputError
from piccolo.result import Result
from piccolo.runtime.line_file import appending, whole_lines, whole_size

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A room's cloud and three panoramas in a folder of their own."""
    words = "--seed 7 --size 4.5 3.5 2.5 --points 60000 --panoramas 3 --width 512"
    return write_room(tmp_path_factory.mktemp("a batch"), words)


@pytest.fixture
def counted(monkeypatch):
    """The panoramas that are localized, in order."""
    names, answer = [], module.Localizer.answer

    def counting(self, scan, task):
        names.append(task.pano.name)
        return answer(self, scan, task)

    monkeypatch.setattr(module.Localizer, "answer", counting)
    return names


def _run(scene, out, *more, pano=None):
    cloud, panos = str(scene / "cloud.ply"), pano or [str(scene / "images")]
    return localize.main(["--cloud", cloud, "--pano", *panos, "--out", str(out), "--no-cache", *more])


def _lines(out):
    """The lines of a file of results without what differs from run to run."""
    return [json.loads(line) | {"seconds": None} for line in out.read_text().splitlines()]


def test_folders_lists_and_standard_input_name_panoramas(scene, tmp_path):
    names = ["clean_0.jpg", "clean_1.jpg", "clean_2.jpg"]
    listed = tmp_path / "list.txt"
    listed.write_text("b c.jpg\n\nd.png\n")
    with (tmp_path / "stdin").open("w+") as stdin:
        stdin.write("e.jpg\r\n\nf.jpg")
        stdin.seek(0)
        found = list(panoramas_of([str(scene), "a.jpg", f"@{listed}", "-"], stdin))
    assert found[:3] == [scene / "images" / name for name in names]
    assert [str(path) for path in found[3:]] == ["a.jpg", "b c.jpg", "d.png", "e.jpg", "f.jpg"]
    cube = tmp_path / "photos" / "cube"
    cube.mkdir(parents=True)
    for face in ("px", "nx", "py", "ny", "pz", "nz"):
        (cube / f"{face}.png").touch()
    (tmp_path / "photos" / "a.webp").touch()
    (tmp_path / "photos" / ".hidden.jpg").touch()
    assert list(panoramas_of([str(tmp_path / "photos")], None)) == [tmp_path / "photos/a.webp", cube]
    assert list(panoramas_of([str(cube)], None)) == [cube]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty: a folder without a JPEG"):
        list(panoramas_of([str(tmp_path / "empty")], None))


def test_a_batch_goes_on_where_it_was_stopped(scene, tmp_path, counted, capsys):
    whole, out = tmp_path / "whole.jsonl", tmp_path / "poses.jsonl"
    assert _run(scene, whole) == 0
    assert "3 panoramas in" in (err := capsys.readouterr().err)
    assert "3 localized, 0 ambiguous, 0 not localized, 0 unreadable" in err
    lines = whole.read_bytes().splitlines(keepends=True)
    for torn in (b"", lines[1][:1], lines[1][:20], lines[1][:-1]):
        counted.clear()
        out.write_bytes(lines[0] + torn)
        assert _run(scene, out, "--quiet") == 0
        assert counted == ["clean_1.jpg", "clean_2.jpg"]
        assert _lines(out) == _lines(whole)
    counted.clear()
    assert _run(scene, out) == 0
    assert counted == []
    assert "nothing is left to do" in capsys.readouterr().err
    assert _run(scene, out, "--quiet", "--overwrite") == 0
    assert len(counted) == 3
    assert _lines(out) == _lines(whole)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--gravity", "known"], "line 1: made with gravity 'auto', not 'known'"),
        (["--height", "0.5", "2"], "line 1: made with prior"),
        (["--cloud", "other"], "line 1: made with another scan, or the scan has changed since"),
        (["--pano", "clean_1.jpg"], "line 1: of "),
        (["--pano", "clean_0.jpg"], "line 2: more results than this command has panoramas"),
        ("photo", "clean_1.jpg has changed since"),
        (b"some notes of the user\n", "line 1: no result of localize.py"),
        (b"notes without an end", "its end is no line of results"),
        (b'{"format": "piccolo-pose/3"}\n', "line 1: of format 'piccolo-pose/3'"),
    ],
)
def test_a_file_of_another_run_is_refused_with_both_ways(scene, tmp_path, change, message, capsys):
    first, second = (scene / "images" / f"clean_{k}.jpg" for k in (0, 1))
    photo = tmp_path / "clean_1.jpg"
    photo.write_bytes(second.read_bytes())
    out, panos = tmp_path / "poses.jsonl", [str(first), str(photo)]
    assert _run(scene, out, "--quiet", pano=panos) == 0
    more = []
    if change == "photo":
        photo.write_bytes(second.read_bytes() + b"\0")
    elif isinstance(change, bytes):
        out.write_bytes(change)
    elif change[0] == "--cloud":
        other = tmp_path / "other.ply"
        other.write_bytes((scene / "cloud.ply").read_bytes() + b"\0")
        more = ["--cloud", str(other)]
    elif change[0] == "--pano":
        panos = [str(scene / "images" / change[1])]
    else:
        more = change
    before = out.read_bytes()
    assert _run(scene, out, "--quiet", *more, pano=panos) == 3
    err = capsys.readouterr().err
    assert message in err
    assert "--overwrite starts anew, another --out keeps both" in err
    assert err.count("\n") == 1
    assert out.read_bytes() == before


def test_an_unreadable_photo_is_a_line_and_stays_one(scene, tmp_path, counted, capsys):
    bad, out = tmp_path / "bad.jpg", tmp_path / "poses.jsonl"
    bad.write_bytes(b"\xff\xd8\xff nothing more")
    panos = [str(bad), str(tmp_path / "missing.jpg"), str(scene / "images" / "clean_0.jpg")]
    for expected in (["bad.jpg", "missing.jpg", "clean_0.jpg"], []):
        counted.clear()
        assert _run(scene, out, pano=panos) == 3
        assert counted == expected
    assert [line["status"] for line in _lines(out)] == ["unreadable", "unreadable", "localized"]
    assert "1 localized, 0 ambiguous, 0 not localized, 2 unreadable" in capsys.readouterr().err
    bad.write_bytes((scene / "images" / "clean_1.jpg").read_bytes())
    assert _run(scene, out, pano=panos) == 3
    assert "bad.jpg has changed since" in capsys.readouterr().err


def _process(scene, out, panos, **options):
    command = [
        sys.executable,
        str(ROOT / "localize.py"),
        "--cloud",
        str(scene / "cloud.ply"),
        "--pano",
        *panos,
    ]
    command += ["--out", str(out)] if out else []
    return subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_a_batch_after_the_photo_at_work(scene, tmp_path, number, code):
    out, name = tmp_path / "poses.jsonl", str(scene / "images" / "clean_0.jpg")
    process = _process(scene, out, [name] * 30)
    while "localized at" not in process.stderr.readline():
        pass
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == code
    assert "the same command goes on from here" in err
    assert "Traceback" not in err
    done = _lines(out)
    assert 1 <= len(done) < 30
    assert out.read_bytes().endswith(b"\n")


def test_names_on_standard_input_are_answered_as_they_come(scene):
    name = str(scene / "images" / "clean_1.jpg")
    with _process(scene, None, ["-", "--quiet"], stdout=subprocess.PIPE, bufsize=1) as process:
        for word, status in ((name, "localized"), ("missing.jpg", "unreadable"), (name, "localized")):
            process.stdin.write(word + "\n")
            process.stdin.flush()
            assert Result.from_json(process.stdout.readline()).status == status
        process.stdin.close()
        assert process.wait(timeout=60) == 3


def test_two_processes_do_not_write_one_file(tmp_path):
    out = tmp_path / "poses.jsonl"
    with appending(out, 0) as append:
        append('{"a": 1}')
        with pytest.raises(InputError, match="another process is writing it"), appending(out, 0):
            pass
    assert out.read_text() == '{"a": 1}\n'
    with pytest.raises(InputError, match="has written it since"), appending(out, 0):
        pass
    with appending(out, whole_size(out, b"{", "a test")) as append:
        append('{"b": 2}')
    assert list(whole_lines(out, out.stat().st_size)) == [b'{"a": 1}\n', b'{"b": 2}\n']
    with appending(tmp_path / "new", 0):
        pass
    assert not (tmp_path / "new").exists()


def test_a_full_disk_keeps_the_lines_before(tmp_path):
    code = (
        "import resource, sys\n"
        "from pathlib import Path\n"
        "from piccolo.runtime.line_file import appending\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "with appending(Path(sys.argv[1]), 0) as append:\n"
        "    for k in range(9):\n"
        "        append(str(k) * 300)\n"
    )
    out = tmp_path / "lines"
    done = subprocess.run(
        [sys.executable, "-c", code, str(out)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert "File too large" in done.stderr
    assert out.read_text() == "".join(f"{str(k) * 300}\n" for k in range(3))


def test_a_full_device_is_named(scene, capsys):
    assert _run(scene, Path("/dev/full"), "--quiet", pano=[str(scene / "images" / "clean_0.jpg")]) == 3
    assert capsys.readouterr().err == "localize.py: /dev/full: cannot be used (No space left on device)\n"


def test_several_pictures_go_into_folders(scene, tmp_path):
    folders = tmp_path / "overlays", tmp_path / "changes"
    for folder in folders:
        folder.mkdir()
    options = ["--overlay", str(folders[0]), "--occlusion-mask", str(folders[1])]
    assert _run(scene, tmp_path / "poses.jsonl", "--quiet", *options) == 0
    for folder in folders:
        assert sorted(path.name for path in folder.iterdir()) == ["clean_0.png", "clean_1.png", "clean_2.png"]


def test_priors_of_a_table_go_before_the_general_one(scene, tmp_path, capsys):
    truth = json.loads((scene / "queries.json").read_text())["queries"]
    x, y, _ = truth[0]["center_world"]
    table, out = tmp_path / "priors.csv", tmp_path / "poses.jsonl"
    table.write_text(
        f"name,x,y,radius,height\nclean_0.jpg,{x},{y},0.5,1.5\nclean_9.jpg,1,2,,\nclean_1.jpg,,,,\n"
    )
    assert _run(scene, out, "--priors", str(table), "--height", "0.2", "2.2") == 0
    assert "1 names of no panorama here, such as clean_9.jpg" in capsys.readouterr().err
    priors = [line["settings"]["prior"] for line in _lines(out)]
    assert priors[0]["near_world"] == [x, y, None]
    assert (priors[0]["radius"], priors[0]["height"]) == (0.5, [1.2, 1.8])
    assert [prior["near_world"] for prior in priors[1:]] == [None, None]
    assert priors[1]["height"] == priors[2]["height"] == [0.2, 2.2]
