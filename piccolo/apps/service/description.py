"""The OpenAPI description of the service; its options are the parameters of `Photo`, `Prior`, `Accuracy`."""

import inspect
import json
import re
import types
from collections.abc import Collection
from importlib.resources import files
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from ... import __version__
from ...api.values import Accuracy
from ...photo.camera import Calibration
from ...photo.photo import Photo, Prior
from .asking import ACCURACY, PHOTO, PRIOR

NAMES = {float: "number", int: "integer", bool: "boolean", str: "string"}
PARAMETERS = re.compile(r"^Parameters\n-+\n(.*?)\n\n", re.DOTALL | re.MULTILINE)
PARAMETER = re.compile(r"^(\w[\w, ]*)\n((?:    .*\n?)+)", re.MULTILINE)
CAMERA = "calibration, as JSON of docs/CAMERAS.md"  # a request has no files


def describe_service() -> dict[str, Any]:
    """Return the description as a JSON object."""
    text = (files("piccolo.apps.service") / "openapi.json").read_text(encoding="utf-8")
    document: dict[str, Any] = json.loads(text)
    document["info"]["version"] = __version__
    schemas = document["components"]["schemas"]
    schemas["PhotoOptions"] = describe_options(Photo, PHOTO)
    schemas["PhotoOptions"]["properties"]["camera"]["description"] = CAMERA
    schemas["PriorOptions"] = describe_options(Prior, PRIOR)
    schemas["AccuracyOptions"] = describe_options(Accuracy, ACCURACY)
    return document


def describe_options(kind: type, names: Collection[str]) -> dict[str, Any]:
    """Return the schema of a JSON object with the named fields of a dataclass, each of which may be null."""
    texts = read_parameters(kind)
    properties = {
        name: {"oneOf": [*describe_kinds(hint), {"type": "null"}], "description": texts[name]}
        for name, hint in get_type_hints(kind).items()
        if name in names
    }
    return {"type": "object", "properties": properties, "additionalProperties": False}


def describe_kinds(hint: Any) -> list[dict[str, Any]]:
    """Return the schemas of the types in an annotation, without None and, beside Calibration, paths."""
    if get_origin(hint) in (Union, types.UnionType):
        kinds = [part for part in get_args(hint) if part is not type(None)]
        if Calibration in kinds:
            kinds = [Calibration]
        return [schema for part in kinds for schema in describe_kinds(part)]
    return [describe_kind(hint)]


def describe_kind(hint: Any) -> dict[str, Any]:
    """Return the schema of a type that is not a union."""
    parts = get_args(hint)
    if get_origin(hint) is Literal:
        return {"type": "string", "enum": list(parts)}
    if parts:
        sizes = ("minItems", "maxItems") if get_origin(hint) is tuple else ()
        return {"type": "array", "items": describe_items(parts), **dict.fromkeys(sizes, len(parts))}
    return {"type": NAMES[hint]} if hint in NAMES else {"type": "object", "additionalProperties": True}


def describe_items(parts: Collection[Any]) -> dict[str, Any]:
    """Return the schema of the items of an array, each of which has one of some types."""
    schemas = []
    for part in dict.fromkeys(parts):
        schemas += describe_kinds(part) + ([{"type": "null"}] if type(None) in get_args(part) else [])
    distinct = [schema for k, schema in enumerate(schemas) if schema not in schemas[:k]]
    return distinct[0] if len(distinct) == 1 else {"oneOf": distinct}


def read_parameters(kind: type) -> dict[str, str]:
    """Return the text of each parameter in the docstring of a class."""
    found = PARAMETERS.search(inspect.getdoc(kind) or "")
    texts: dict[str, str] = {}
    for names, text in PARAMETER.findall(found[1] if found else ""):
        texts |= dict.fromkeys(names.split(", "), " ".join(text.split()))
    return texts
