"""Camera positions and paths on the plans, without a browser: PNG, SVG, PDF, and DXF for CAD."""

import io
import math
from collections.abc import Iterator, Sequence
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ...api.values import AMBIGUOUS, LOCALIZED, NOT_LOCALIZED
from ...photo.panorama.picture import read_picture
from ...scan_map.scan_map import ScanMap
from ...system.arrays import Array
from ...system.errors import import_optional
from ...system.files.atomic import temporary_folder, write_atomically
from .build import PictureTask, ReportSettings, check_settings, make_document
from .site import Entry, begin_folder

DXF = ".dxf"
SUFFIXES = (".png", ".svg", ".pdf", DXF)
COLORS = {LOCALIZED: (8, 120, 76), AMBIGUOUS: (166, 83, 0), NOT_LOCALIZED: (193, 37, 45)}
MARKERS = {LOCALIZED: "o", AMBIGUOUS: "D", NOT_LOCALIZED: "^"}  # so that not the colour alone tells
INK = (20, 32, 46)
DPI = 100  # a pixel of a plan is one of the PNG
PAGE_MARGIN = 0.5  # [inch] around a plan
SIZE = 12.0  # [pt] of a mark
FRAME_SIZE = 5.0  # [pt] of that of a walk's frame
PATH_WIDTH = 3.5  # [pt]
HEADING = 0.5  # [m] length of the line from a mark
FRAME_HEADING = 0.2  # [m]
TEXT_HEIGHT = 0.12  # [m] of the DXF
BARS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # [m] of the scale
LEAST_ON_PATH = 0.5  # frames that are less likely right are passed over
EVERY_NUMBER = 20  # of a walk's frames are numbered


class Line(NamedTuple):
    """A heading, or a part of a walk's path."""

    ends: Array  # (2, 3) [m]
    color: tuple[int, int, int]
    width: float  # [pt]
    is_dashed: bool = False


class Ellipse(NamedTuple):
    """The region in which a camera lies with a probability of 95 %."""

    center: Array  # (3,) [m]
    half_axes: tuple[float, float]  # [m]
    angle: float  # [rad] of the larger one, counterclockwise from +x
    color: tuple[int, int, int]


class Mark(NamedTuple):
    """A camera."""

    center: Array  # (3,) [m]
    status: str
    size: float  # [pt]
    number: str  # beside it; empty for most of a walk's frames
    name: str


Shape = Line | Ellipse | Mark


def write_plan_file(entries: Sequence[Entry], scan_map: ScanMap, out: Path, settings: ReportSettings) -> int:
    """Write the positions as the suffix says; how many storeys there are.

    PNG, SVG, PDF: the plans of the storeys, one below the other. DXF: points, headings, 95 % ellipses and
    names in the scan's own coordinates, a layer a storey.
    """
    check_settings(settings, scan_map, entries)
    suffix = out.suffix.lower()
    with temporary_folder() as folder:
        begin_folder(folder)
        tasks = [PictureTask(entry, Path(), "", []) for entry in entries]
        document = make_document(tasks, scan_map, folder, settings)
        content = make_dxf(document) if suffix == DXF else draw_figure(document, folder, suffix[1:])
    write_atomically(out, content)
    return len(document["storeys"])


def draw_shapes(document: dict[str, Any], index: int) -> Iterator[Shape]:
    """Yield the shapes drawn of a storey, in the map's frame: paths first, marks last."""
    numbered = enumerate(document["photos"], 1)
    photos = [(n, photo) for n, photo in numbered if photo["isOnPlan"] and photo["storey"] in (index, None)]
    for begin, end in segments_of([photo for _, photo in photos]):
        ends = np.array([begin["pose"]["center"], end["pose"]["center"]])
        color = color_of(min(begin["confidence"], end["confidence"]))
        yield Line(ends, color, PATH_WIDTH, is_dashed=end["gap"])  # no walking person can have gone there
    for number, photo in photos:
        center = np.array(photo["pose"]["center"])
        color = COLORS[photo["status"]]
        is_frame = photo["walk"] is not None
        ahead = np.array([*photo["pose"]["rotation"][:2], 0.0])
        ahead *= (FRAME_HEADING if is_frame else HEADING) / max(float(np.linalg.norm(ahead)), 1e-12)
        yield Line(np.array([center, center + ahead]), color, 2.0)
        if photo["spread"]:
            a, b, degrees = photo["spread"]["ellipse"]
            yield Ellipse(center, (a, b), math.radians(degrees), color)
        text = "" if is_frame and number % EVERY_NUMBER != 1 else str(number)
        yield Mark(center, photo["status"], FRAME_SIZE if is_frame else SIZE, text, photo["name"])


def draw_figure(document: dict[str, Any], folder: Path, form: str) -> bytes:
    """Return the plans one below the other as matplotlib draws them, with a scale each."""
    plans = [(k, storey) for k, storey in enumerate(document["storeys"]) if storey["plan"]]
    sides = [np.array([s["plan"]["width"], s["plan"]["height"]]) / DPI + PAGE_MARGIN for _, s in plans]
    heights = [float(side[1]) for side in sides] or [1.0]
    size = max([float(side[0]) for side in sides] or [1.0]), sum(heights)
    figure = import_optional("`plan`", "matplotlib.figure", "plans").Figure(figsize=size, dpi=DPI)
    top = sum(heights)
    for (k, storey), (width, height) in zip(plans, sides, strict=True):
        top -= height
        box = PAGE_MARGIN / 2, top + PAGE_MARGIN / 4, width - PAGE_MARGIN, height - PAGE_MARGIN
        axes = figure.add_axes((np.array(box) / np.tile(figure.get_size_inches(), 2)).tolist())
        _draw_plan(axes, storey, folder)
        for shape in draw_shapes(document, k):
            _draw(axes, shape)
        if any(photo["walk"] is not None for photo in document["photos"]):
            _draw_scale(axes)
    file = io.BytesIO()
    how = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(form, {})
    options = {"svg.fonttype": "none", "svg.hashsalt": "piccolo"}  # texts stay texts, the same each time
    with import_optional("`plan`", "matplotlib", "plans").rc_context(options):
        figure.savefig(file, format=form, metadata=how)
    return file.getvalue()


def _draw_plan(axes: Any, storey: dict[str, Any], folder: Path) -> None:
    """Draw the plan of a storey with its name and scale, in metres of the map's frame."""
    from matplotlib.transforms import Affine2D  # noqa: PLC0415  # half a second

    plan = storey["plan"]
    picture = read_picture(folder / plan["file"], (1, 1))
    rgba = np.dstack([picture.rgb, 255 * picture.is_valid.astype(np.uint8)])
    to_metres = Affine2D.from_values(*plan["matrix"])
    width, height = plan["width"], plan["height"]
    corners = to_metres.transform([(0, 0), (width, 0), (0, height), (width, height)])
    axes.imshow(rgba, extent=(0, width, height, 0), transform=to_metres + axes.transData)
    left, bottom = corners.min(axis=0)
    right, top = corners.max(axis=0)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.set_axis_off()
    axes.set_title(storey["name"], loc="left", color=_fraction(INK))
    metres = max((m for m in BARS if m < (right - left) / 4.0), default=0.2)
    axes.plot([left, left + metres], [bottom, bottom], color=_fraction(INK), lw=4, clip_on=False)
    axes.annotate(f"{metres:g} m", (left + metres, bottom), (4, 2), textcoords="offset points")


def _draw_scale(axes: Any) -> None:
    """Draw the colours of a walk's path."""
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415
    from matplotlib.colors import Normalize  # noqa: PLC0415

    colors = ScalarMappable(Normalize(LEAST_ON_PATH, 1.0), "viridis_r")
    place = axes.inset_axes((0.72, 1.02, 0.26, 0.02))
    bar = axes.figure.colorbar(colors, cax=place, orientation="horizontal")
    bar.set_ticks([LEAST_ON_PATH, 1.0], labels=[f"{LEAST_ON_PATH:g}", "1"])
    axes.text(0.71, 1.02, "confidence", transform=axes.transAxes, ha="right")


def _draw(axes: Any, shape: Shape) -> None:
    from matplotlib import patches  # noqa: PLC0415

    if isinstance(shape, Line):
        style = (0, (1, 2)) if shape.is_dashed else "-"
        axes.plot(*shape.ends[:, :2].T, color=_fraction(shape.color), lw=shape.width, ls=style)
    elif isinstance(shape, Ellipse):
        width, height = 2.0 * np.array(shape.half_axes)
        ellipse = patches.Ellipse(tuple(shape.center[:2]), width, height, angle=math.degrees(shape.angle))
        ellipse.set(fill=False, edgecolor=_fraction(shape.color))
        axes.add_patch(ellipse)
    else:
        color = _fraction(COLORS[shape.status])
        is_sure = shape.status == LOCALIZED
        fill, edge = (color, "white") if is_sure else ("white", color)  # a guess is hollow
        (mark,) = axes.plot(*shape.center[:2], marker=MARKERS[shape.status], ms=shape.size, gid=shape.name)
        mark.set(markerfacecolor=fill, markeredgecolor=edge, markeredgewidth=1.5)
        place = (shape.size / 2 + 2, shape.size / 2)
        axes.annotate(shape.number, tuple(shape.center[:2]), place, textcoords="offset points", weight="bold")


def _fraction(color: tuple[int, int, int]) -> tuple[float, ...]:
    return tuple(value / 255.0 for value in color)


def make_dxf(document: dict[str, Any]) -> bytes:
    """Points, headings, 95 % ellipses and names in metres of the scan's coordinates."""
    ezdxf = import_optional("`plan`", "ezdxf", "plans")
    drawing = ezdxf.new("R2010", setup=True)
    drawing.header["$INSUNITS"] = 6
    drawing.header["$PDMODE"] = 34
    drawing.header["$PDSIZE"] = 0.1
    R_map_from_world = np.array(document["R"]).reshape(3, 3)
    for k, storey in enumerate(document["storeys"]):
        name = "".join("_" if letter in '<>/\\":;?*|=`,' else letter for letter in storey["name"])
        layer = f"PHOTOS {k + 1} {name}"[:200]  # as DXF takes it
        drawing.layers.add(layer)
        for shape in draw_shapes(document, k):
            _add(drawing.modelspace(), shape, layer, R_map_from_world, np.array(document["origin"]))
    file = io.StringIO()
    drawing.write(file)
    return file.getvalue().encode("utf-8")


def _add(space: Any, shape: Shape, layer: str, R_map_from_world: Array, origin: Array) -> None:
    """Draw a shape in the world's coordinates, but no ellipse smaller than a hundredth of a millimetre."""
    color = COLORS[shape.status] if isinstance(shape, Mark) else shape.color
    how = {"layer": layer, "true_color": color[0] << 16 | color[1] << 8 | color[2]}
    if isinstance(shape, Line):
        space.add_line(*(shape.ends @ R_map_from_world + origin).tolist(), dxfattribs=how)
        return
    center = shape.center @ R_map_from_world + origin
    if isinstance(shape, Mark):
        space.add_point(center.tolist(), dxfattribs=how)
        text = space.add_text(shape.name, height=TEXT_HEIGHT, dxfattribs=how)
        text.set_placement((center + np.array([0.1, 0.1, 0.0])).tolist())
    elif shape.half_axes[1] > 1e-5:
        a, b = shape.half_axes
        axis = a * np.array([math.cos(shape.angle), math.sin(shape.angle), 0.0]) @ R_map_from_world
        space.add_ellipse(center.tolist(), axis.tolist(), b / a, dxfattribs=how)


def segments_of(photos: Sequence[dict[str, Any]]) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Yield frames and the next on a walk's path, of the photos of a plan, but from storey to storey."""
    frames = sorted((p for p in photos if p["walk"] is not None), key=lambda p: (p["walk"], p["time"]))
    for _, walk in groupby(frames, key=lambda p: p["walk"]):
        known = [p for p in walk if p["pose"] and p["confidence"] >= LEAST_ON_PATH]
        for begin, end in pairwise(known):
            if begin["storey"] == end["storey"] or None in (begin["storey"], end["storey"]):
                yield begin, end


def color_of(confidence: float) -> tuple[int, int, int]:
    """Red, green, blue: viridis from yellow (0.5) to dark blue (1)."""
    share = (1.0 - np.clip(confidence, LEAST_ON_PATH, 1.0)) / (1.0 - LEAST_ON_PATH)
    level = np.array([[round(255 * share)]], np.uint8)
    blue, green, red = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS)[0, 0]
    return int(red), int(green), int(blue)
