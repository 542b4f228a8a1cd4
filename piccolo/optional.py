"""Libraries that only some formats and tools need."""

from importlib import import_module
from pathlib import Path
from types import ModuleType

from .errors import ResourceError


def import_optional(what: Path | str, module_name: str, extra: str = "formats") -> ModuleType:
    """Return the module that `what` needs, or a ResourceError that says how to install it."""
    try:
        return import_module(module_name)
    except ImportError as error:
        raise ResourceError(
            f"{what}: needs {module_name}, which can't be imported ({error}); "
            f"pip install 'piccolo-localize[{extra}]', in a checkout: -r requirements-{extra}.txt"
        ) from error
