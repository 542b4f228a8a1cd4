"""A request: a photo by its name and content, and its options as JSON."""

import json
import os
import re
from collections.abc import Collection, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from ..camera.calibration import calibration_of
from ..errors import UNPRINTABLE, InputError, printable
from ..files.json_file import DAMAGE
from ..localization.settings import CoarseToFineSettings
from ..photo import Photo, Prior

PARTS = ("photo", "prior", "gravity", "min_confidence")
# options of a photo that name no file
PHOTO = {f.name for f in fields(Photo)} - {"picture", "mask", "rig"}
PRIOR = {f.name for f in fields(Prior)}
MAX_NAME = (
    240  # bytes of a photo's name that are kept; a file's name has up to 255, with what is put before it
)


def clean_name(name: str) -> str:
    """Return the name of a file that was sent, without the folders above; it is no path."""
    own = UNPRINTABLE.sub("_", re.split(r"[/\\]", name)[-1])
    kept = os.fsencode(own)[-MAX_NAME:].decode(errors="ignore")
    return kept if kept.strip(". ") else "photo"


def parse_options(text: str) -> dict[str, Any]:
    """Return the options that came as JSON; InputError if they are no object, or one is unknown."""
    try:
        options = json.loads(text) if text else {}
    except (ValueError, RecursionError) as error:
        raise InputError(f"options: found no JSON ({printable(str(error))})") from error
    return check_object(options, PARTS, "options")


def check_object(given: object, known: Collection[str], where: str) -> dict[str, Any]:
    """Return a JSON object; InputError for anything else, and for a name that is not known."""
    if not isinstance(given, dict):
        raise InputError(f"{where}: found {type(given).__name__}, wanted a JSON object")
    if unknown := given.keys() - set(known):
        wanted = ", ".join(sorted(known))
        raise InputError(f"{where}: found {printable(min(unknown))[:40]!r}, wanted any of {wanted}")
    return given


def make_photo(name: str, options: Mapping[str, Any]) -> Photo:
    """Return the photo with the options of its part; its calibration is JSON in place of a file."""
    given = check_object(options.get("photo", {}), PHOTO, "options.photo")
    try:
        if given.get("camera") is not None:
            given = {**given, "camera": calibration_of(given["camera"], "options.photo.camera")}
        return Photo(Path(name), **given)
    except DAMAGE as error:
        raise InputError(f"options.photo: {error}") from error


def apply_options(settings: CoarseToFineSettings, options: Mapping[str, Any]) -> CoarseToFineSettings:
    """Return the settings of a photo: those of the service, with the request's own in their place."""
    given = check_object(options.get("prior", {}), PRIOR, "options.prior")
    changed = {name: options[name] for name in ("gravity", "min_confidence") if options.get(name) is not None}
    try:
        return replace(settings, prior=replace(settings.prior, **given), **changed)
    except DAMAGE as error:
        raise InputError(f"options: {error}") from error
