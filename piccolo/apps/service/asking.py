"""The content of a request: photos with names, and their options as JSON."""

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
# options of a photo, without those that are paths of files
PHOTO = {f.name for f in fields(Photo)} - {"picture", "mask", "rig"}
PRIOR = {f.name for f in fields(Prior)}
ACCURACY = {f.name for f in fields(Accuracy)}
PLACES: dict[str, Collection[str]] = {"options": PARTS, "options.photo": PHOTO, "options.prior": PRIOR}
# [byte] of a photo's name that are kept: with what is put before it, a file's name can have 255
MAX_NAME = 240
FORM = "wanted multipart/form-data with `picture`, a file or several, and perhaps `options`, one text of JSON"
Pictures = dict[str, bytes]  # contents of files by name


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
    """Return a sent file's name without folders and unprintable characters; it never acts as a path."""
    own = UNPRINTABLE.sub("_", re.split(r"[/\\]", name)[-1])
    kept = os.fsencode(own)[-MAX_NAME:].decode(errors="ignore")
    return kept if kept.strip(". ") else "photo"


def parse_options(text: str) -> dict[str, Any]:
    """Return the options in a text of JSON. Raise InputError if it is no object, or has an unknown name."""
    try:
        options = json.loads(text) if text else {}
    except (ValueError, RecursionError) as error:
        raise InputError(f"options: found no JSON ({printable(str(error))})") from error
    return check_object(options, PARTS, "options")


def check_object(given: object, known: Collection[str], where: str) -> dict[str, Any]:
    """Return a JSON object without the members that are null.

    Raise InputError if it is no object, or has a name that is not among `known`; `where` names it.
    """
    if not isinstance(given, dict):
        raise InputError(f"{where}: found {type(given).__name__}, wanted a JSON object")
    if unknown := given.keys() - set(known):
        raise InputError(f"{where}: {describe_unknown(min(unknown), known)}")
    return {name: value for name, value in given.items() if value is not None}


def describe_unknown(name: str, known: Collection[str]) -> str:
    """Return words on a name that is unknown: where it belongs, or which are known."""
    place = next((place for place, names in PLACES.items() if name in names), None)
    wanted = f"it in {place}" if place else f"any of {', '.join(sorted(known))}"
    return f"found {printable(name)[:40]!r}, wanted {wanted}"


def make_asked_photo(name: str, options: Mapping[str, Any]) -> Photo:
    """Return the photo of a name with the options of a request; its calibration is JSON, not a file."""
    given = check_object(options.get("photo", {}), PHOTO, "options.photo")
    try:
        if "camera" in given:
            given = {**given, "camera": calibration_of(given["camera"], "options.photo.camera")}
        return Photo(Path(name), **given)
    except DAMAGE as error:
        raise InputError(f"options.photo: {error}") from error


def are_together(options: Mapping[str, Any]) -> bool:
    """Return the option `together`, whether the photos are of one place. InputError if no boolean."""
    given = options.get("together", False)
    if not isinstance(given, bool):
        raise InputError(f"options.together: found {printable(str(given))[:40]!r}, wanted true or false")
    return given


def apply_options(settings: CoarseToFineSettings, options: Mapping[str, Any]) -> CoarseToFineSettings:
    """Return the settings of a photo: the service's, replaced where the request has options."""
    given = check_object(options.get("prior", {}), PRIOR, "options.prior")
    wanted = check_object(options.get("accuracy", {}), ACCURACY, "options.accuracy")
    changed = {name: options[name] for name in ("gravity", "min_confidence") if name in options}
    try:
        prior = replace(settings.prior, **given)
        return replace(settings, prior=prior, accuracy=replace(settings.accuracy, **wanted), **changed)
    except DAMAGE as error:
        raise InputError(f"options: {error}") from error
