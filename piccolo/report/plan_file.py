"""Camera positions on the plans, for those without a browser: PNG, SVG, and DXF for CAD."""

import base64
import io
import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
from numpy.typing import NDArray

from ..coarse_to_fine.scan_map import ScanMap
from ..confidence.confidence import AMBIGUOUS, LOCALIZED, NOT_LOCALIZED
from ..panorama.picture import read_picture
from ..render.surfel_renderer import encode_image
from ..runtime.atomic import write_atomically
from ..runtime.optional import import_optional
from .build import ReportSettings, Task, check_settings, document_of
from .entries import Entry, Place
from .plan_path import LEAST_ON_PATH, color_of, draw_scale, is_numbered, segments_of
from .site import begin_folder

SUFFIXES = (".png", ".svg", ".dxf")
COLORS = {LOCALIZED: (8, 120, 76), AMBIGUOUS: (166, 83, 0), NOT_LOCALIZED: (193, 37, 45)}
CAD_COLORS = {LOCALIZED: 3, AMBIGUOUS: 30, NOT_LOCALIZED: 1}  # of AutoCAD's index
ROUND = np.linspace(0.0, math.tau, 32, endpoint=False)
SHAPES = {  # corners of marks of radius 1, so that not the colour alone tells
    LOCALIZED: np.column_stack([np.cos(ROUND), np.sin(ROUND)]),
    AMBIGUOUS: np.array([[0.0, -1.2], [1.2, 0.0], [0.0, 1.2], [-1.2, 0.0]]),
    NOT_LOCALIZED: np.array([[0.0, -1.15], [1.1, 0.85], [-1.1, 0.85]]),
}
INK = (20, 32, 46)
TITLE = 60  # [px] above each plan
RADIUS, FRAME_RADIUS = 9, 4  # [px] of a mark, and of a walk's frame
PATH_WIDTH, SCALE = 5, (160, 14)  # [px] of a walk's path, and of the scale of its colours
HEADING = 1.0  # [m] length of a line in the DXF
TEXT_HEIGHT = 0.12  # [m] of the DXF
FONT = cv2.FONT_HERSHEY_DUPLEX
SHIFT = 4  # bits of cv2's fractions of pixels


def write_plan_file(entries: Sequence[Entry], scan_map: ScanMap, out: Path, settings: ReportSettings) -> int:
    """Write the positions as the suffix says; how many storeys there are.

    PNG and SVG: the plans of the storeys, one below the other. DXF: points, headings, 95 % ellipses and names
    in the scan's own coordinates, a layer a storey.
    """
    place = Place(scan_map, scan_map.storeys)
    check_settings(settings, place)
    with TemporaryDirectory(prefix="piccolo-") as made:
        folder = Path(made)
        begin_folder(folder)
        tasks = [Task(entry, Path(), "", []) for entry in entries]
        document = document_of(tasks, place, folder, settings)
        if out.suffix.lower() == ".dxf":
            content = dxf_of(document)
        else:
            content = (png_of if out.suffix.lower() == ".png" else svg_of)(document, folder)
    write_atomically(out, content)
    return len(document["storeys"])


def on_storey(document: dict[str, Any], index: int) -> list[tuple[int, dict[str, Any]]]:
    """The photos of a storey that have a pose, with their numbers from 1."""
    photos = enumerate(document["photos"], 1)
    return [(number, photo) for number, photo in photos if photo["pose"] and photo["storey"] in (index, None)]


def pixels_of_plan(plan: dict[str, Any], xy: Sequence[float]) -> NDArray[np.float64]:
    """Pixel (2,) of a place (2,) [m] of the map's frame."""
    a, b, c, d, e, f = plan["matrix"]
    return np.linalg.solve(np.array([[a, c], [b, d]]), np.array(xy[:2]) - np.array([e, f]))


def heading_in_pixels(plan: dict[str, Any], rotation: Sequence[float]) -> NDArray[np.float64]:
    """Unit direction (2,) in pixels in which a camera looks, by R_cam_from_map (9,)."""
    a, b, c, d, *_ = plan["matrix"]
    ahead = np.linalg.solve(np.array([[a, c], [b, d]]), np.array(rotation[:2]))
    return np.asarray(ahead / max(float(np.linalg.norm(ahead)), 1e-12))


def png_of(document: dict[str, Any], folder: Path) -> bytes:
    """The plans one below the other, with marks, numbers and scale bars."""
    sheets = [
        _drawn_sheet(storey, on_storey(document, k), folder)
        for k, storey in enumerate(document["storeys"])
        if storey["plan"]
    ]
    width = max((sheet.shape[1] for sheet in sheets), default=2 * TITLE)
    padded = [np.pad(s, ((0, 0), (0, width - s.shape[1]), (0, 0)), constant_values=255) for s in sheets]
    blank = np.full((TITLE, width, 3), 255, np.uint8)
    return encode_image(np.concatenate([*padded, blank]), ".png")


def _drawn_sheet(
    storey: dict[str, Any], photos: list[tuple[int, dict[str, Any]]], folder: Path
) -> NDArray[np.uint8]:
    plan = storey["plan"]
    picture = read_picture(folder / plan["file"], (1, 1))
    rgb = np.where(picture.is_valid[..., None], picture.rgb, np.uint8(255))
    sheet = np.pad(rgb, ((TITLE, 0), (0, 0), (0, 0)), constant_values=255)
    text = f"{storey['name']}   1 px = {1000 * plan['pixel']:.0f} mm"
    cv2.putText(sheet, text, (12, 40), FONT, 0.8, INK, 2, cv2.LINE_AA)
    metres = _bar_length(plan["width"] * plan["pixel"])
    end = 12 + round(metres / plan["pixel"])
    cv2.line(sheet, (12, 52), (end, 52), INK, 4, cv2.LINE_AA)
    cv2.putText(sheet, f"{metres:g} m", (end + 8, 57), FONT, 0.5, INK, 1, cv2.LINE_AA)
    _draw_paths(sheet, plan, [photo for _, photo in photos])
    for number, photo in photos:
        size = radius_of(photo)
        at = pixels_of_plan(plan, photo["pose"]["center"]) + np.array([0.0, TITLE])
        tip = at + 3.0 * size * heading_in_pixels(plan, photo["pose"]["rotation"])
        color = COLORS[photo["status"]]
        ends = [tuple(round(x * (1 << SHIFT)) for x in point) for point in (at, tip)]
        cv2.line(sheet, ends[0], ends[1], color, 3 if size == RADIUS else 1, cv2.LINE_AA, SHIFT)
        for radius, fill in ((1.25 * size, (255, 255, 255)), (size, color)):
            corners = np.rint((at + radius * SHAPES[photo["status"]]) * (1 << SHIFT)).astype(np.int32)
            cv2.fillPoly(sheet, [corners], fill, cv2.LINE_AA, SHIFT)
        if not is_numbered(number, photo):
            continue
        where = round(at[0]) + RADIUS + 3, round(at[1]) - RADIUS
        for thickness, ink in ((4, (255, 255, 255)), (1, INK)):
            cv2.putText(sheet, str(number), where, FONT, 0.55, ink, thickness, cv2.LINE_AA)
    return np.asarray(sheet, np.uint8)


def radius_of(photo: dict[str, Any]) -> int:
    """Of a photo's mark [px]: those of a walk lie close together."""
    return RADIUS if photo["walk"] is None else FRAME_RADIUS


def _draw_paths(sheet: NDArray[np.uint8], plan: dict[str, Any], photos: list[dict[str, Any]]) -> None:
    """The paths of walks, and what their colours mean."""
    segments = list(segments_of(photos))
    for s in segments:
        ends = [pixels_of_plan(plan, photo["pose"]["center"]) for photo in (s.begin, s.end)]
        first, last = ((round(u * (1 << SHIFT)), round((v + TITLE) * (1 << SHIFT))) for u, v in ends)
        cv2.line(
            sheet, first, last, color_of(s.confidence), 1 if s.is_gap else PATH_WIDTH, cv2.LINE_AA, SHIFT
        )
    left, (width, height) = sheet.shape[1] - SCALE[0] - 150, SCALE
    if segments and left > 0:
        draw_scale(sheet, left, 30, width, height)
        for text, at in ((f"{LEAST_ON_PATH:g}", left - 40), ("1 confidence", left + width + 8)):
            cv2.putText(sheet, text, (at, 42), FONT, 0.5, INK, 1, cv2.LINE_AA)


def _bar_length(width: float) -> float:
    """Length [m] of the scale bar of a plan."""
    return max((m for m in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0) if m < width / 4.0), default=0.2)


def svg_of(document: dict[str, Any], folder: Path) -> bytes:
    """The same with vectors over the plans; a user unit is a millimetre of the building."""
    ElementTree.register_namespace("", "http://www.w3.org/2000/svg")
    root = ElementTree.Element("{http://www.w3.org/2000/svg}svg")
    y, widest = 0.0, 0.0
    for k, storey in enumerate(document["storeys"]):
        if plan := storey["plan"]:
            scale = 1000.0 * plan["pixel"]
            title = _add(root, "text", x="100", y=f"{y + 450:.0f}", **{"font-size": "350"})
            title.text = storey["name"]
            group = _add(root, "g", transform=f"translate(0 {y + 600:.0f}) scale({scale:.6f})")
            _add_plan(group, plan, folder)
            photos = on_storey(document, k)
            _add_paths(group, plan, [photo for _, photo in photos])
            for number, photo in photos:
                _add_photo(group, plan, number, photo)
            y += 1000.0 + scale * plan["height"]
            widest = max(widest, scale * plan["width"])
    root.set("viewBox", f"0 0 {widest:.0f} {y:.0f}")
    text: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return text


def _add(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, f"{{http://www.w3.org/2000/svg}}{tag}", attributes)


def _add_plan(group: ElementTree.Element, plan: dict[str, Any], folder: Path) -> None:
    content = base64.b64encode((folder / plan["file"]).read_bytes()).decode()
    size = {"width": str(plan["width"]), "height": str(plan["height"])}
    _add(group, "image", href=f"data:image/png;base64,{content}", **size)
    metres = _bar_length(plan["width"] * plan["pixel"])
    end, bottom = 10.0 + metres / plan["pixel"], plan["height"] - 10.0
    _add(group, "path", d=f"M10 {bottom}H{end:.2f}", stroke="#14202e", **{"stroke-width": "4"})
    _add(
        group, "text", x=f"{end + 6:.2f}", y=f"{bottom + 5:.2f}", **{"font-size": "16"}
    ).text = f"{metres:g} m"


def _add_paths(group: ElementTree.Element, plan: dict[str, Any], photos: list[dict[str, Any]]) -> None:
    for s in segments_of(photos):
        (x1, y1), (x2, y2) = (pixels_of_plan(plan, photo["pose"]["center"]) for photo in (s.begin, s.end))
        color = "#{:02x}{:02x}{:02x}".format(*color_of(s.confidence))
        line = _add(
            group, "line", x1=f"{x1:.2f}", y1=f"{y1:.2f}", x2=f"{x2:.2f}", y2=f"{y2:.2f}", stroke=color
        )
        line.set("stroke-width", str(PATH_WIDTH))
        line.set("stroke-linecap", "round")
        if s.is_gap:
            line.set("stroke-dasharray", "4 8")


def _add_photo(group: ElementTree.Element, plan: dict[str, Any], number: int, photo: dict[str, Any]) -> None:
    u, v = pixels_of_plan(plan, photo["pose"]["center"])
    size = radius_of(photo)
    du, dv = 3.0 * size * heading_in_pixels(plan, photo["pose"]["rotation"])
    color = "#{:02x}{:02x}{:02x}".format(*COLORS[photo["status"]])
    mark = _add(group, "g", fill=color, stroke=color)
    _add(mark, "title").text = f"{photo['name']}: {photo['status'].replace('_', ' ')}"
    _add(mark, "path", d=f"M{u:.2f} {v:.2f}l{du:.2f} {dv:.2f}", **{"stroke-width": "3"})
    _add(mark, "circle", cx=f"{u:.2f}", cy=f"{v:.2f}", r=str(size), stroke="#ffffff", **{"stroke-width": "2"})
    if spread := photo["spread"]:
        a, b, degrees = spread["ellipse"]
        radii = {"rx": f"{a / plan['pixel']:.3f}", "ry": f"{b / plan['pixel']:.3f}"}
        turn = f"translate({u:.2f} {v:.2f}) rotate({-degrees:.2f})"
        _add(mark, "ellipse", transform=turn, fill="none", **radii)
    if not is_numbered(number, photo):
        return
    text = _add(mark, "text", x=f"{u + RADIUS + 3:.2f}", y=f"{v - RADIUS:.2f}", stroke="none")
    text.set("font-size", "16")
    text.text = str(number)


def dxf_of(document: dict[str, Any]) -> bytes:
    """Points, headings, 95 % ellipses and names in metres of the scan's coordinates."""
    ezdxf = import_optional("--plan", "ezdxf", "tools")
    drawing = ezdxf.new("R2010", setup=True)
    drawing.header["$INSUNITS"], drawing.header["$PDMODE"], drawing.header["$PDSIZE"] = 6, 34, 0.1
    space = drawing.modelspace()
    for k, storey in enumerate(document["storeys"]):
        layer = _layer_name(storey["name"], k)
        drawing.layers.add(layer)
        for _, photo in on_storey(document, k):
            how = {"layer": layer, "color": CAD_COLORS[photo["status"]]}
            x, y, z = photo["pose"]["world"]
            heading = math.radians(90.0 - photo["pose"]["angles"][0])
            space.add_point((x, y, z), dxfattribs=how)
            tip = x + HEADING * math.cos(heading), y + HEADING * math.sin(heading), z
            space.add_line((x, y, z), tip, dxfattribs=how)
            text = space.add_text(photo["name"], height=TEXT_HEIGHT, dxfattribs=how)
            text.set_placement((x + 0.1, y + 0.1, z))
            if photo["spread"]:
                _add_ellipse(space, photo, how, document["R"])
        for s in segments_of([photo for _, photo in on_storey(document, k)]):
            ends = [tuple(photo["pose"]["world"]) for photo in (s.begin, s.end)]
            path = space.add_line(*ends, dxfattribs={"layer": layer})
            path.rgb = color_of(s.confidence)
    file = io.StringIO()
    drawing.write(file)
    return file.getvalue().encode("utf-8")


def _layer_name(name: str, index: int) -> str:
    """A storey's name as DXF takes it."""
    kept = "".join("_" if letter in '<>/\\":;?*|=`,' else letter for letter in name)
    return f"PHOTOS {index + 1} {kept}"[:200]


def _add_ellipse(space: Any, photo: dict[str, Any], how: dict[str, Any], R: Sequence[float]) -> None:
    """The ellipse of a photo, if it is not smaller than a hundredth of a millimetre."""
    a, b, degrees = photo["spread"]["ellipse"]
    angle = math.radians(degrees) - math.atan2(R[3], R[0])  # from the map's frame to the world's
    if b > 1e-5:
        axis = a * math.cos(angle), a * math.sin(angle), 0.0
        space.add_ellipse(photo["pose"]["world"], axis, b / a, dxfattribs=how)
