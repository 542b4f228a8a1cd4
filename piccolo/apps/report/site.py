"""The page of a report, which opens from disk: what it says of each result, its files, its data as scripts.

A page of file:// may run scripts and show images beside it, but fetch nothing, and read no pixel of them:
what WebGL shows lies in scripts, one a photo. Names of files are digests of what they were made from, so that
what is there already need not be made again. One file holds all of it where the report is self-contained.
"""

import base64
import hashlib
import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...api.result_files import read_results
from ...api.values import FAILED, NOT_LOCALIZED, SHOWN, UNREADABLE, PoseCovariance, Reason, Result
from ...geometry.pose import Pose, heading_pitch_roll_deg
from ...geometry.pose_gaussian import turn_positions
from ...scan_map.scan_map import ScanMap
from ...system.arrays import Array
from ...system.errors import printable
from ...system.files.atomic import check_output_folder, write_atomically

INDEX = "index.html"
PAGE_FILES = ("app.js", "app.css")
FOLDERS = {"photos": ".js", "thumbs": ".jpg", "plans": ".png"}
KEY = re.compile(r"[0-9a-f]{32}")
MARK = "piccolo-report"  # in the page, by which a folder is known as a report
# of a page on disk: the origin of a file is nobody's, so that 'self' alone may match nothing
POLICY = (
    "default-src 'none'; base-uri 'none'; form-action 'none'; img-src 'self' file: data: blob:; "
    "script-src {script}; style-src {style}"
)
OWN = "'self' file:"
CHI_SQUARE_95 = 5.991  # of two degrees of freedom
NOT_TOLD = {Reason.MIRRORED, Reason.SPHERE}  # reasons that rule out poses, not by what was told of the photo
ENDING = re.compile(r"\.[A-Za-z0-9]{3,4}( \(\d+\))?$")
DIGITS = 6  # of positions [m] and rotations
EVIDENCE = ("score", "margin", "explained_fraction", "seen_fraction", "contradicted_fraction", "num_matches")
NOT_FOUND = ("pose", "storey", "height", "evidence", "spread")
NOTHING_FOUND: dict[str, Any] = {**dict.fromkeys(NOT_FOUND), "alternatives": []}


class Entry(NamedTuple):
    """A result of a report."""

    result: Result
    walk: int | None  # which walk it is of, a number; None for a photo that stands alone
    time: float  # [s] by which a walk's photos are in order; else its place in the files


def collect_entries(items: Sequence[Path | Result]) -> list[Entry]:
    """Return the results given and those in files; the frames of a file, or those given, are one walk."""
    entries: list[Entry] = []
    for number, item in enumerate(items):
        is_given = isinstance(item, Result)
        for result in [item] if isinstance(item, Result) else read_results([item]):
            time = result.walk.time if result.walk else float(len(entries))
            walk = -1 if is_given else number
            entries.append(Entry(result, walk if result.walk else None, time))
    return entries


def unique_names(entries: Sequence[Entry]) -> list[str]:
    """Return a name for each, which no other has: its path below the folder that all share."""
    paths = [Path(entry.result.pano) for entry in entries]
    folders = [path.parent.parts for path in paths]
    shared = 0
    while all(len(f) > shared and f[shared] == folders[0][shared] for f in folders):
        shared += 1
    names = []
    counts = Counter[str]()
    for path in paths:
        name = printable("/".join(path.parts[shared:]))
        counts[name] += 1
        names.append(f"{name} ({counts[name]})" if counts[name] > 1 else name)
    return names


def shorten_names(names: Sequence[str]) -> list[str]:
    """Return the file's own name without its ending, or the name as it is where several would be the same."""
    own = [ENDING.sub(r"\1", name.rpartition("/")[2]) for name in names]
    counts = Counter(own)
    return [short if counts[short] == 1 else name for short, name in zip(own, names, strict=True)]


def document_of_entry(entry: Entry, name: str, key: str, scan_map: ScanMap) -> dict[str, Any]:
    """Return what the page knows of a result before it is opened; angles in degrees, lengths in metres."""
    result = entry.result
    contradicts = list_contradicted(result)
    accuracy = result.settings.get("accuracy")
    is_unlikely = result.status == NOT_LOCALIZED and result.place_probability < SHOWN
    is_hopeless = is_unlikely and not contradicts
    return {
        "name": name,
        "key": key,
        "status": UNREADABLE if result.status == FAILED else result.status,  # the page has no word for it
        "confidence": round(result.confidence, 5),
        "placeProbability": round(result.place_probability, 5),
        "accuracy": list(accuracy.values()) if accuracy else None,
        "hint": result.hint,
        "probabilityNone": _round(result.probability_none, 5),
        "error": result.error and _below(result.error, result.pano, name),
        "warnings": [_below(warning, result.pano, name) for warning in result.warnings],
        "contradicts": contradicts,
        "isOnPlan": result.best_pose is not None and not is_hopeless,
        "scan": result.scan,
        "beside": [printable(Path(photo).name) for photo in (result.beside.photos if result.beside else ())],
        "captured": result.source.capture_time,
        "size": result.source.image_size,
        "walk": entry.walk,
        "time": entry.time if entry.walk is not None else None,
        "gap": bool(result.walk and result.walk.gap),
        **(document_of_found(result, result.best_pose, scan_map) if result.best_pose else NOTHING_FOUND),
    }


def list_contradicted(result: Result) -> list[Reason]:
    """List what was told of a photo that rules its poses out."""
    return sorted(result.belief.ruled_out - NOT_TOLD)


def document_of_found(result: Result, best_pose: Pose, scan_map: ScanMap) -> dict[str, Any]:
    """Return what was found: the best pose, the others, and what speaks for them."""
    poses = [best_pose, *(alternative.pose for alternative in result.alternatives)]
    centers = np.array([scan_map.from_world(pose).center_world for pose in poses])
    storey, height = scan_map.storeys.at(centers)
    storeys = [int(k) if k >= 0 else None for k in storey]
    alternatives = [
        {
            **pose_document(other.pose, scan_map),
            "score": round(other.score, 3),
            "probability": round(other.probability, 5),
            "scan": other.scan,
            "storey": storey,
        }
        for other, storey in zip(result.alternatives, storeys[1:], strict=True)
    ]
    evidence = result.evidence
    covariance = result.covariance
    R_map_from_world = scan_map.R_map_from_world
    return {
        **pose_document(best_pose, scan_map),
        "storey": storeys[0],
        "height": None if storeys[0] is None else round(float(height[0]), 3),
        "alternatives": alternatives,
        "evidence": evidence and {name: _round(getattr(evidence, name), 4) for name in EVIDENCE},
        "spread": covariance and spread_document(covariance, R_map_from_world),
    }


def pose_document(pose: Pose, scan_map: ScanMap) -> dict[str, Any]:
    """Return a pose in the plan's frame, and as the world has it."""
    local = scan_map.from_world(pose)
    heading, pitch, roll = heading_pitch_roll_deg(pose)
    return {
        "pose": {
            "center": _list(local.center_world),
            "rotation": _list(local.R_cam_from_world.ravel()),
            "world": _list(pose.center_world),
            "worldRotation": _list(pose.R_cam_from_world.ravel(), 12),
            "angles": [round(heading, 2), round(pitch, 2), round(roll, 2)],
        }
    }


def spread_document(covariance: PoseCovariance, R_map_from_world: Array) -> dict[str, Any]:
    """Describe the pose's uncertainty: its 95 % ellipse on the plan [m], standard deviations, and words.

    The covariance itself is that of the turn about the camera's axes [rad] and of the position in the plan's
    frame [m], the 21 numbers of its rows from the diagonal on.
    """
    in_plan = turn_positions(covariance.matrix, R_map_from_world)
    variances, axes = np.linalg.eigh(in_plan[3:5, 3:5])
    half = np.sqrt(np.maximum(variances, 0.0) * CHI_SQUARE_95)
    return {
        "ellipse": [*_list(half[::-1]), round(math.degrees(math.atan2(axes[1, 1], axes[0, 1])), 2)],
        "covariance": [float(f"{value:.4g}") for value in in_plan[np.triu_indices(6)]],
        "deg": _list(covariance.std_deg, 4),
        "largest": round(1000.0 * covariance.largest_std, 2),
        "direction": covariance.least_constrained_direction,
    }


def _below(words: str, pano: str, name: str) -> str:
    """Words on a photo with its name in place of its path."""
    return printable(words.replace(pano, name))


def _list(values: Array, digits: int = DIGITS) -> list[float]:
    return [round(float(value), digits) for value in values]


def _round(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def page_file(name: str) -> str:
    """Return a file of the page, as the package has it."""
    return (files("piccolo.apps.report") / "page" / name).read_text(encoding="utf-8")


def as_script_text(document: object) -> str:
    """JSON that may stand in a script: nothing in it can end one."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def check_folder(out: Path) -> None:
    """Refuse a folder that could not be made, or that has something in it which is no report."""
    if not (out / f".{MARK}").is_file():
        check_output_folder(out)


def begin_folder(out: Path) -> None:
    """Make the folders, and mark them as a report's."""
    for name in FOLDERS:
        (out / name).mkdir(parents=True, exist_ok=True)
    write_atomically(out / f".{MARK}", b"Files here are replaced by tools/report.py.\n")


def picture_path(out: Path, folder: str, key: str) -> Path:
    """Return the path of a photo's or plan's file."""
    return out / folder / f"{key}{FOLDERS[folder]}"


def write_photo_script(out: Path, key: str, document: str) -> None:
    """Write the pictures of a photo, in JSON, as a script that hands them to the page."""
    write_atomically(picture_path(out, "photos", key), photo_script(key, document).encode())


def photo_script(key: str, document: str) -> str:
    """Return the script that hands the pictures of a photo, in JSON, to the page."""
    return f'(window.PICCOLO_PHOTOS ??= {{}})["{key}"] = {document};\n'


def finish_folder(out: Path, document: Mapping[str, Any]) -> None:
    """Write the page and its data, and remove what earlier reports here left of photos."""
    for name in PAGE_FILES:
        write_atomically(out / name, page_file(name).encode())
    write_atomically(out / "report.js", report_script(document).encode())
    write_atomically(out / INDEX, page_under(POLICY.format(script=OWN, style=OWN)).encode())
    used = {str(photo["key"]) for photo in document["photos"]}
    used |= {Path(s["plan"]["file"]).stem for s in document["storeys"] if s["plan"]}
    for name, suffix in FOLDERS.items():
        for path in (out / name).iterdir():
            is_ours = path.suffix == suffix and KEY.fullmatch(path.stem)
            is_left = path.name.startswith(".") and KEY.match(path.name.lstrip("."))
            if (is_ours and path.stem not in used) or is_left:
                path.unlink()


def report_script(document: Mapping[str, Any]) -> str:
    """Return the script that hands its data to the page."""
    return f"window.PICCOLO_REPORT = {as_script_text(document)};\n"


def page_under(policy: str) -> str:
    """Return the page that takes data, script and style from beside it, under a Content-Security-Policy."""
    return page_file(INDEX).replace("{{policy}}", policy)


def self_contained(folder: Path, document: Mapping[str, Any]) -> str:
    """Return the page with everything in it; its pictures lie in a folder, as those of other reports do."""
    inlined = json.loads(json.dumps(document))
    for photo in inlined["photos"]:
        if photo["thumb"]:
            photo["thumb"] = data_url((folder / photo["thumb"]).read_bytes(), "image/jpeg")
    for storey in inlined["storeys"]:
        if storey["plan"]:
            plan = folder / storey["plan"]["file"]
            storey["plan"]["file"] = data_url(plan.read_bytes(), "image/png")
    script = page_file("app.js")
    style = page_file("app.css")
    data = [f'<script type="application/json" id="report">{as_script_text(inlined)}</script>']
    for photo in document["photos"]:
        if photo["hasPictures"]:
            script_of_photo = picture_path(folder, "photos", photo["key"]).read_text()
            text = script_of_photo.partition(" = ")[2].removesuffix(";\n")
            data.append(f'<script type="application/json" id="photo-{photo["key"]}">{text}</script>')
    page = page_under(POLICY.format(script=_hash_of(script), style=_hash_of(style)))
    page = page.replace('<link rel="stylesheet" href="app.css">', f"<style>{style}</style>")
    page = page.replace('<script defer src="report.js"></script>', "")
    page = page.replace('<script defer src="app.js"></script>', "")
    return page.replace("</body>", "\n".join([*data, f"<script>{script}</script>", "</body>"]))


def _hash_of(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def data_url(content: bytes, kind: str) -> str:
    """Return a picture as an address that holds it."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
