"""Photo Sphere XMP in JPEGs: the pose comes back, everything else stays."""

import re
import struct
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from pictures import encoded, smooth_rgb, write
from poses import jpeg, result, rotation, tilted_poses
from refusals import assert_input_error, mutated, read_or_refused

from piccolo.apps.export.formats import export
from piccolo.apps.export.posed_images import Options
from piccolo.photo.panorama import panorama_size
from piccolo.photo.panorama.gpano import EMPTY_PACKET, SCAN, jpeg_segments, with_pose, without_pose
from piccolo.system.errors import InputError

ANGLES = (123.25, -10.5, 7.0)
XMP_MARK = b"http://ns.adobe.com/xap/1.0/\0"
RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
GPANO = "{http://ns.google.com/photos/1.0/panorama/}"
POSE_OF = re.compile(rb'GPano:Pose(Heading|Pitch|Roll)Degrees="([-\d.]+)"')
# As cameras write it: fields as elements and attributes, under two prefixes, beside those of others.
CAMERA_PACKET = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b"<rdf:Description rdf:about='uuid:1' xmlns:GPano=\"http://ns.google.com/photos/1.0/panorama/\""
    b' xmlns:p="http://ns.google.com/photos/1.0/panorama/" xmlns:dc="http://purl.org/dc/elements/1.1/"'
    b' GPano:PoseHeadingDegrees="350.0" dc:format="image/jpeg">'
    b"<GPano:ProjectionType>equirectangular</GPano:ProjectionType><p:PoseRollDegrees/>"
    b"<GPano:CroppedAreaLeftPixels>100</GPano:CroppedAreaLeftPixels>"
    b"<p:PosePitchDegrees >4.0</p:PosePitchDegrees ></rdf:Description></rdf:RDF></x:xmpmeta>"
)


def _segment(body, marker=0xE1):
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body


def _with_segments(data, *segments):
    """The JPEG with segments behind its first one, JFIF's."""
    place = next(jpeg_segments(data)).end
    return data[:place] + b"".join(segments) + data[place:]


def _packets(data):
    bodies = [data[s.begin + 4 : s.end] for s in jpeg_segments(data) if s.marker == 0xE1]
    return [body[len(XMP_MARK) :] for body in bodies if body.startswith(XMP_MARK)]


def _fields(packet):
    """Photo Sphere fields by an XML parser: attributes and elements of all descriptions, each once."""
    found = []
    for description in ElementTree.fromstring(packet).iter(f"{RDF}Description"):
        found += [*description.attrib.items(), *((child.tag, child.text) for child in description)]
    names = [name for name, _ in found if name.startswith(GPANO)]
    assert len(names) == len(set(names))
    return {name.removeprefix(GPANO): text for name, text in found}


def _without_xmp(data):
    """All bytes but those of XMP segments."""
    kept, begin = b"", 0
    for s in jpeg_segments(data):
        if data[s.begin + 4 : s.end].startswith(XMP_MARK):
            kept, begin = kept + data[begin : s.begin], s.end
    return kept + data[begin:]


def test_pose_comes_back_and_the_picture_stays(tmp_path):
    images = tmp_path / "photos"
    (images / "upper").mkdir(parents=True)
    poses = tilted_poses(3)
    names = ["a.jpg", "b.jpg", "upper/b.jpg"]
    originals = [jpeg(images / name, seed=seed) for seed, name in enumerate(names)]
    results = [result(images / name, pose) for name, pose in zip(names, poses, strict=True)]
    export(results, "gpano", tmp_path / "out", Options(images=images))
    for name, original, pose in zip(names, originals, poses, strict=True):
        copy = (tmp_path / "out" / name).read_bytes()
        assert (images / name).read_bytes() == original
        assert _without_xmp(copy) == original
        found = {kind.decode(): float(number) for kind, number in POSE_OF.findall(copy)}
        R = rotation(found["Heading"], found["Pitch"], found["Roll"])
        np.testing.assert_allclose(R, pose.R_cam_from_world.T, atol=1e-10)
    with pytest.raises(InputError, match=r"b\.jpg: two pictures have this name"):
        export(results, "gpano", tmp_path / "other", Options())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "photos"]


def test_new_packet_follows_jfif_and_exif_and_says_what_viewers_need(tmp_path):
    exif = _segment(b"Exif\0\0MM\0*\0\0\0\x08\0\0\0\0\0\0")
    mpf = _segment(b"MPF\0", 0xE2)
    data = _with_segments(jpeg(tmp_path / "a.jpg"), exif, mpf)
    copy = with_pose(tmp_path / "a.jpg", data, ANGLES)
    kinds = [copy[s.begin + 4 : s.begin + 8] for s in jpeg_segments(copy)][:4]
    assert kinds == [b"JFIF", b"Exif", b"http", b"MPF\0"]
    assert _without_xmp(copy) == data
    fields = _fields(*_packets(copy))
    assert fields["ProjectionType"] == "equirectangular"
    assert (fields["FullPanoWidthPixels"], fields["CroppedAreaImageHeightPixels"]) == ("512", "256")


def test_fields_of_others_stay_and_the_old_pose_goes(tmp_path):
    packet = b'<?xpacket begin="" id="x"?>' + CAMERA_PACKET + b" " * 2048 + b'<?xpacket end="w"?>'
    second = CAMERA_PACKET.replace(b"</rdf:RDF>", b"<!-- second --></rdf:RDF>")
    segments = [_segment(XMP_MARK + packet), _segment(b"Exif\0\0late"), _segment(XMP_MARK + second)]
    data = _with_segments(jpeg(tmp_path / "a.jpg"), *segments)
    copy = with_pose(tmp_path / "a.jpg", data, ANGLES)
    assert _without_xmp(copy) == _without_xmp(data)
    first, other = _packets(copy)
    fields = _fields(first)
    assert [float(fields[f"Pose{k}Degrees"]) for k in ("Heading", "Pitch", "Roll")] == list(ANGLES)
    assert fields["{http://purl.org/dc/elements/1.1/}format"] == "image/jpeg"
    assert fields["CroppedAreaLeftPixels"] == "100"
    assert "FullPanoWidthPixels" not in fields  # the crop of the file is not added to
    assert first.count(b"about='uuid:1'") == 2
    assert b"Pose" not in other
    assert with_pose(tmp_path / "a.jpg", copy, ANGLES) == copy  # once more changes nothing


def test_only_the_pose_is_taken_out_of_a_packet_and_a_damaged_one_gives_way(tmp_path):
    assert without_pose(EMPTY_PACKET) == EMPTY_PACKET
    stranger = CAMERA_PACKET.replace(b"http://ns.google.com/photos/1.0/panorama/", b"http://other/")
    assert without_pose(stranger) == stranger
    assert len(without_pose(b" " * 65_000 + CAMERA_PACKET)) > 65_000  # in no time
    data = _with_segments(jpeg(tmp_path / "a.jpg"), _segment(XMP_MARK + CAMERA_PACKET[:-30]))
    copy = with_pose(tmp_path / "a.jpg", data, ANGLES)
    assert _fields(*_packets(copy))["PosePitchDegrees"] == "-10.500000000"


def test_refusals(tmp_path):
    path = tmp_path / "a.jpg"
    data = jpeg(path)
    scan = next(s for s in jpeg_segments(data) if s.marker == SCAN)
    for damaged in (b"", b"\x89PNG", data[: scan.begin], data[:30], b"\xff\xd8" + b"\xff" * 1000):
        assert_input_error(r"a\.jpg: no JPEG, or a damaged one", with_pose, path, damaged, ANGLES)
    full = EMPTY_PACKET + b" " * 65_200
    with pytest.raises(InputError, match="leaves no room for the pose"):
        with_pose(path, _with_segments(data, _segment(XMP_MARK + full)), ANGLES)
    with pytest.raises(InputError, match=r"found 512 x 128, wanted width = 2 x height"):
        with_pose(path, jpeg(path, (512, 128)), ANGLES)


@given(st.data())
@settings(max_examples=100)
def test_any_damage_of_a_picture_is_refused_or_copied(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("damaged") / "a.jpg"
    whole = _with_segments(jpeg(path, (64, 32)), _segment(XMP_MARK + CAMERA_PACKET))
    path.write_bytes(mutated(data.draw, st.integers, whole))
    read_or_refused(panorama_size, path)
    copy, _ = read_or_refused(lambda path: with_pose(path, path.read_bytes(), ANGLES), path)
    assert copy is None or b"".join(_packets(copy)).count(b"GPano:PoseHeadingDegrees") >= 1


def test_sizes_are_read_without_decoding_those_of_cube_faces_are_the_spheres_and_damage_is_refused(tmp_path):
    for name in ("px", "nx", "py", "ny", "pz", "nz"):
        write(tmp_path / f"{name}.png", encoded(smooth_rgb(64, 64), ".png"))
    assert panorama_size(tmp_path) == (256, 128)
    for suffix in (".jpg", ".png", ".tif", ".webp"):
        content = encoded(smooth_rgb(), suffix)
        part = content[: -len(content) // 3] if suffix in (".jpg", ".png") else content
        assert panorama_size(write(tmp_path / "a", part)) == (128, 64)
    results = [result(tmp_path / "b.jpg", tilted_poses(1)[0])]
    for content in (b"", b"\xff\xd8" + b"\xff" * 9999, b"II*\0" + bytes(99), b"\xff\xd8\xff\xe1\xff\xff" * 9):
        write(tmp_path / "b.jpg", content)
        with pytest.raises(InputError, match=r"b\.jpg: .*with `size` W H no picture is needed"):
            export(results, "nerfstudio", tmp_path / "t.json", Options())
