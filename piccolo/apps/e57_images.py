"""List the images inside an E57 file, one JSON object a line, and write them as files if asked."""

import json
from argparse import ArgumentParser
from pathlib import Path

from ..cli.command import Arguments, check_distinct, check_folder_name, command, option
from ..cloud.readers.e57 import E57Image, list_images, read_image
from ..geometry.pose import quaternion_wxyz
from ..photo.camera import Camera, Mount
from ..photo.camera.calibration import document_of
from ..system.errors import InputError
from ..system.files.atomic import write_atomically, write_json

EPILOG = """\
example:
  python tools/e57_images.py scan.e57 --extract photos
  python localize.py --cloud scan.e57 --pano photos/scan_0.jpg

is_usable: the image is spherical (fov_deg is 360 for a full sphere), or a pinhole, whose calibration is
written beside it: localize.py reads it by --camera photos.
pose: that of the file, x_world = R_world_from_image @ x_image + center_world.
"""


def image_json(index: int, image: E57Image) -> dict[str, object]:
    """Return the JSON object of an image."""
    pose = image.pose and {
        "quaternion_wxyz_world_from_image": quaternion_wxyz(image.pose.R_cam_from_world.T).tolist(),
        "center_world": image.pose.center_world.tolist(),
    }
    names = "name", "kind", "width", "height", "fov_deg", "encoding"
    row = {"index": index, **{name: getattr(image, name) for name in names}, "bytes": image.size}
    is_usable = image.kind == "spherical" or bool(image.pinhole)
    return {**row, "is_usable": is_usable, "pose": pose, "scan_guid": image.scan_guid or None}


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    parser.add_argument("e57", type=Path, metavar="FILE", help="E57 file")
    option(parser, "--extract FOLDER", "write the images to this folder")


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """List and, if asked, write the images; returns the exit code. A broken one doesn't stop the others."""
    check_folder_name("--extract", arguments.extract)
    images = list_images(arguments.e57)
    exit_code = 0
    if arguments.extract:
        files = {image.file_name: arguments.extract / image.file_name for image in images}
        check_distinct(files, [arguments.e57])
        arguments.extract.mkdir(exist_ok=True)
    for index, image in enumerate(images):
        row = image_json(index, image)
        if arguments.extract:
            try:
                file = files[image.file_name]
                write_atomically(file, read_image(arguments.e57, index))
                row["file"] = str(file)
                if image.pinhole:
                    camera = Camera("PINHOLE", image.width, image.height, image.pinhole)
                    write_json(file.with_suffix(".camera.json"), document_of([Mount(camera)]))
            except InputError as error:
                exit_code = arguments.error(str(error))
        print(json.dumps(row, allow_nan=False), flush=True)
    return exit_code
