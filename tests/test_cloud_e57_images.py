import json

import numpy as np
import pytest
from e57_files import ImageToWrite, with_xml, write
from refusals import assert_refused
from test_cloud_e57 import CENTER, QUATERNION, R_WORLD, scan

from piccolo.cli import e57_images
from piccolo.cloud.readers.e57 import list_images, read_image
from piccolo.geometry.pose import quaternion_wxyz

SPHERE = {"imageWidth": 400, "imageHeight": 200, "pixelWidth": np.pi / 200, "pixelHeight": np.pi / 200}
SMALL = {"imageWidth": 30, "imageHeight": 20}
JPEG, PNG = b"\xff\xd8\xff and a picture" * 90, b"\x89PNG\r\n\x1a\n and a picture"
IMAGES = [
    ImageToWrite(JPEG, "sphericalRepresentation", "jpegImage", SPHERE, name="pano", scan_guid="{scan}"),
    ImageToWrite(PNG, "pinholeRepresentation", "pngImage", SMALL, QUATERNION, tuple(CENTER)),
    ImageToWrite(PNG, "cylindricalRepresentation", "pngImage", SMALL),
    ImageToWrite(JPEG, "visualReferenceRepresentation", "jpegImage", SMALL),
]


def test_images_are_listed_and_read(tmp_path):
    path = write(tmp_path / "a.e57", [scan()], IMAGES)
    images = list_images(path)
    assert [image.kind for image in images] == ["spherical", "pinhole", "cylindrical", "visual-reference"]
    first = images[0]
    assert (first.name, first.width, first.height, first.size) == ("pano", 400, 200, len(JPEG))
    assert images[0].fov_deg == pytest.approx((360.0, 180.0))
    assert (images[0].scan_guid, images[0].pose, images[1].fov_deg) == ("{scan}", None, None)
    np.testing.assert_allclose(images[1].pose.R_cam_from_world.T, R_WORLD, atol=1e-12)
    np.testing.assert_array_equal(images[1].pose.center_world, CENTER)
    assert [read_image(path, k) for k in range(4)] == [JPEG, PNG, PNG, JPEG]
    assert list_images(write(tmp_path / "b.e57", [scan()])) == []


def test_images_are_written_as_files(tmp_path, capsys):
    path = write(tmp_path / "a scan.e57", [], [*IMAGES, ImageToWrite(b"GIF", numbers=SMALL)])
    assert e57_images.main([str(path)]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["is_usable"] for row in rows] == [True, False, False, False, True]
    assert rows[1]["pose"]["quaternion_wxyz_world_from_image"] == pytest.approx(quaternion_wxyz(R_WORLD))
    assert "file" not in rows[0]
    folder = tmp_path / "photos"
    assert e57_images.main([str(path), "--extract", str(folder)]) == 3  # the last is broken
    captured = capsys.readouterr()
    rows = [json.loads(line) for line in captured.out.splitlines()]
    assert "image 4 begins with b'GIF', wanted a jpeg file" in captured.err
    names = sorted(p.name for p in folder.iterdir())
    assert names == ["a_scan_0.jpg", "a_scan_1.png", "a_scan_2.png", "a_scan_3.jpg"]
    assert (folder / "a_scan_0.jpg").read_bytes() == JPEG
    assert rows[0]["file"] == str(folder / "a_scan_0.jpg")


def test_the_tool_names_its_errors_by_exit_codes(tmp_path, capsys):
    assert e57_images.main([str(tmp_path / "none.e57")]) == 3
    (tmp_path / "a.e57").write_bytes(b"ASTM-E57")
    assert e57_images.main([str(tmp_path / "a.e57")]) == 3
    assert "e57_images.py: " in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        e57_images.main([])
    assert stop.value.code == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'length="25"', b'length="99999999"', "image 0 promises 99999999 bytes, found"),
        (b'length="25"', b'length="-1"', "image 0 promises -1 bytes, found"),
        (b'length="25"', 'length="²"'.encode(), "wanted an integer"),
        (b">30</imageWidth>", b">0</imageWidth>", "an image's imageWidth is 0, wanted 1 to"),
        (b">30</imageWidth>", b">1e999</imageWidth>", "found '1e999' in the XML section"),
    ],
)
def test_damaged_images_are_refused(tmp_path, old, new, message):
    path = write(tmp_path / "a.e57", [], [ImageToWrite(JPEG[:25], numbers=SMALL)])
    path.write_bytes(with_xml(path.read_bytes(), old, new))
    assert_refused(message, list_images, path)
