import sys

import numpy as np
import pytest
from e57_files import ImageToWrite, ScanToWrite, sealed, with_xml, write
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import assert_refused, mutated, read_or_refused
from test_cloud_e57 import BYTES, cartesian, colored, read, scan

from piccolo.cloud import open_source
from piccolo.cloud.readers import e57_file
from piccolo.cloud.readers.e57 import list_images, read_image
from piccolo.errors import InputError


def with_header(content, position, value):
    return sealed(content[:position] + value.to_bytes(8, "little") + content[position + 8 :])


CUT, LONG = "the file is cut off or broken", 1 << 40


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content[:-1024], CUT),
        (lambda content: content[:30], "and 30 bytes, wanted 'ASTM-E57'"),
        (lambda content: b"ASTM-E58" + content[8:], "unknown format|begins with b'ASTM-E58'"),
        (lambda content: with_header(content, 16, LONG), CUT),
        (lambda content: with_header(content, 24, LONG), "bytes of XML from byte 1099511627776 on, wanted"),
        (lambda content: with_header(content, 32, LONG), "promises 1099511627776 bytes of XML"),
        (lambda content: with_header(content, 40, 4096), "in pages of 4096 bytes, wanted 1 and 1024"),
        (lambda content: content[:300] + bytes([content[300] ^ 1]) + content[301:], "checksum mismatch"),
    ],
)
def test_damaged_files_are_refused(tmp_path, change, message):
    path = write(tmp_path / "a.e57", [scan()])
    path.write_bytes(change(path.read_bytes()))
    assert_refused(message, read, path)


BOMB = b'<?xml version="1.0"?><!DOCTYPE e [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><e57Root'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'recordCount="1200"', b'recordCount="1201"', "promises 1201 points, found 1200|broken E57 file"),
        (b'recordCount="1200"', b'recordCount="9999999999999"', "promises 9999999999999 points of 216 bits"),
        (b'recordCount="1200"', b'recordCount="' + b"9" * 5000 + b'"', "wanted an integer"),
        (b'recordCount="1200"', b'recordCount="many"', "found 'many' in the XML section, wanted an integer"),
        (b'recordCount="1200"', b'recordCount="+-5"', "wanted an integer"),
        (b'recordCount="1200"', b'recordCount="-5"', r"scan 1 of 1 \('a scan'\) has -5 points"),
        (b'maximum="255"', b'maximum="0"', "colours without a range: colorRed is declared 0 to 0"),
        (b'<?xml version="1.0" encoding="UTF-8"?>\n<e57Root', BOMB, "a document type definition"),
        (b"<e57Root", b'<e57Root xsi:noNamespaceSchemaLocation="/etc/x"', "XML section is broken"),
        (
            b"<e57Root",
            b'<e57Root xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
            b'xsi:noNamespaceSchemaLocation="/etc/x"',
            "a schema in another file",
        ),
        (b"2010-e57-v1.0", b"2010-e57-v9.0", "no element e57Root of E57 1.0"),
        (b"</data3D>", b"", "the XML section is broken"),
        (b"</data3D>", b"<x>" * 40 + b"</x>" * 40 + b"</data3D>", "or 32 levels"),
        (b"</data3D>", b"<x/>" * 20_001 + b"</data3D>", "more than 500 elements .* or 20000 in a vector"),
        (b"</e57Root>", b"<x/>" * 500 + b"</e57Root>", "more than 500 elements in a structure"),
        (b">2.5e-01</w>", b">nan</w>", "found 'nan' in the XML section, wanted a finite number"),
        (b">2.5e-01</w>", b">0</w>", r"rotation is \[0.0, 0.0, 0.0, 0.0\], wanted a quaternion"),
        (b'"UTF-8"', b'"UTF-99"', "XML section is broken"),
    ],
)
def test_damaged_xml_is_refused(tmp_path, old, new, message):
    path = write(tmp_path / "a.e57", [scan(rotation_wxyz=(0.25, 0.0, 0.0, 0.0))])
    path.write_bytes(with_xml(path.read_bytes(), old, new))
    with pytest.raises(InputError, match=message) as error:
        read(path)
    assert str(path) in str(error.value)
    assert len(str(error.value)) < 500 + len(str(path))


def test_limits_of_the_xml_section(tmp_path, monkeypatch):
    path = write(tmp_path / "a.e57", [scan()])
    monkeypatch.setattr(e57_file, "MAX_ELEMENTS", 10)
    assert_refused("more than 10 elements", read, path)
    monkeypatch.setattr(e57_file, "MAX_XML_SIZE", 500)
    assert_refused(r"promises \d+ bytes of XML from byte \d+ on, wanted 500 at most", read, path)


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    path = write(tmp_path / "a.e57", [scan()])
    monkeypatch.setitem(sys.modules, "pye57.libe57", None)
    assert_refused(r"needs pye57\.libe57, .*-r requirements-formats\.txt", open_source, path)


def read_all(path):
    for index, _ in enumerate(list_images(path)):
        read_or_refused(lambda p, k=index: read_image(p, k), path)
    return read(path)


@settings(deadline=None, max_examples=50)
@given(data=st.data(), is_sealed=st.booleans())
def test_mutated_files_raise_nothing_but_input_error(tmp_path_factory, data, is_sealed):
    folder = tmp_path_factory.getbasetemp()
    path = folder / "mutated.e57"
    if not (folder / "whole.e57").exists():
        columns = {name: column[:60] for name, column in (cartesian() | colored()).items()}
        columns["cartesianInvalidState"] = np.zeros(60, dtype=np.int64)
        write(
            folder / "whole.e57",
            [ScanToWrite(columns, BYTES | {"cartesianInvalidState": (0, 2)}, None, (0.5, 0.5, 0.5, 0.5))],
            [ImageToWrite(b"\xff\xd8\xff and a picture", numbers={"imageWidth": 4, "imageHeight": 2})],
        )
    content = mutated(data.draw, st.integers, (folder / "whole.e57").read_bytes())
    path.write_bytes(sealed(content) if is_sealed else content)
    result, _ = read_or_refused(read_all, path)
    if result is not None:
        assert result[0].shape == result[1].shape
