"""A request: photos by their names and contents, and their options as JSON."""

import json
import os
import re
from collections.abc import Collection, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from starlette.datastructures import FormData, UploadFile

from ...api.values import Accuracy, CoarseToFineSettings
from ...photo.camera.calibration import calibration_of
from ...photo.photo import Photo, Prior
from ...system.errors import UNPRINTABLE, InputError, printable
from ...system.files.json_file import DAMAGE

PARTS = ("photo", "prior", "gravity", "accuracy", "min_confidence", "together")
# options of a photo that name no file
PHOTO = {f.name for f in fields(Photo)} - {"picture", "mask", "rig"}
PRIOR = {f.name for f in fields(Prior)}
ACCURACY = {f.name for f in fields(Accuracy)}
PLACES: dict[str, Collection[str]] = {"options": PARTS, "options.photo": PHOTO, "options.prior": PRIOR}
# bytes of a photo's name that are kept; a file's name has up to 255, with what is put before it
MAX_NAME = 240
FORM = "wanted multipart/form-data with `picture`, a file or several, and perhaps `options`, one text of JSON"
Pictures = dict[str, bytes]  # contents by names


async def read_form(form: FormData) -> tuple[Pictures, str]:
    """Return the pictures in a form, and the text of its options."""
    for name in form:
        if name not in ("picture", "options"):
            raise InputError(f"{describe_unknown(name, ('picture', 'options'))}; {FORM}")
    pictures: Pictures = {}
    text = form.get("options", "")
    if len(form.getlist("options")) > 1 or not isinstance(text, str):
        raise InputError(f"found options twice, or as a file, {FORM}")
    for picture in form.getlist("picture"):
        if not isinstance(picture, UploadFile):
            raise InputError(f"found a picture that is no file, {FORM}")
        name = clean_name(picture.filename or "")
        if name in pictures:
            raise InputError(f"found two pictures named {name!r}, wanted names that differ")
        pictures[name] = await picture.read()
    if not pictures:
        raise InputError(f"found no picture, {FORM}")
    return pictures, text


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
    """Return what a JSON object gives; null is not given.

    Raises InputError for anything else, and for a name that is not known.
    """
    if not isinstance(given, dict):
        raise InputError(f"{where}: found {type(given).__name__}, wanted a JSON object")
    if unknown := given.keys() - set(known):
        raise InputError(f"{where}: {describe_unknown(min(unknown), known)}")
    return {name: value for name, value in given.items() if value is not None}


def describe_unknown(name: str, known: Collection[str]) -> str:
    """Return words on an option that is unknown, or that belongs elsewhere."""
    place = next((place for place, names in PLACES.items() if name in names), None)
    wanted = f"it in {place}" if place else f"any of {', '.join(sorted(known))}"
    return f"found {printable(name)[:40]!r}, wanted {wanted}"


def make_asked_photo(name: str, options: Mapping[str, Any]) -> Photo:
    """Return the photo with the options of its part; its calibration is JSON in place of a file."""
    given = check_object(options.get("photo", {}), PHOTO, "options.photo")
    try:
        if "camera" in given:
            given = {**given, "camera": calibration_of(given["camera"], "options.photo.camera")}
        return Photo(Path(name), **given)
    except DAMAGE as error:
        raise InputError(f"options.photo: {error}") from error


def are_together(options: Mapping[str, Any]) -> bool:
    """Return True if the photos are said to be of one place; InputError for what is no truth value."""
    given = options.get("together", False)
    if not isinstance(given, bool):
        raise InputError(f"options.together: found {printable(str(given))[:40]!r}, wanted true or false")
    return given


def apply_options(settings: CoarseToFineSettings, options: Mapping[str, Any]) -> CoarseToFineSettings:
    """Return the settings of a photo: those of the service, with the request's own in their place."""
    given = check_object(options.get("prior", {}), PRIOR, "options.prior")
    wanted = check_object(options.get("accuracy", {}), ACCURACY, "options.accuracy")
    changed = {name: options[name] for name in ("gravity", "min_confidence") if name in options}
    try:
        prior = replace(settings.prior, **given)
        return replace(settings, prior=prior, accuracy=replace(settings.accuracy, **wanted), **changed)
    except DAMAGE as error:
        raise InputError(f"options: {error}") from error
