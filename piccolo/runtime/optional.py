"""Libraries that only some formats need."""

from importlib import import_module
from pathlib import Path
from types import ModuleType

from ..errors import InputError


def import_optional(path: Path, module_name: str) -> ModuleType:
    """The module that reads `path`, or an InputError that says how to install it."""
    try:
        return import_module(module_name)
    except ImportError as error:
        raise InputError(
            f"{path}: this format needs {module_name}, which can't be imported ({error}), "
            "wanted: pip install -r requirements-formats.txt"
        ) from error
