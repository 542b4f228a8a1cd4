"""Libraries that only some formats and tools need."""

from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from .errors import ResourceError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def import_optional(what: Path | str, module_name: str, extra: str = "formats") -> ModuleType:
    """Return the module that `what` needs, or a ResourceError that says how to install it."""
    try:
        return import_module(module_name)
    except ImportError as error:
        raise ResourceError(
            f"{what}: needs {module_name}, which can't be imported ({error}); "
            f"pip install 'piccolo-localize[{extra}]', in a checkout: -r requirements-{extra}.txt"
        ) from error


def new_figure(**options: Any) -> "Figure":
    """Return an empty figure that belongs to no window, by matplotlib, whose import takes half a second."""
    figure: Figure = import_optional("a plot", "matplotlib.figure", "tools").Figure(**options)
    return figure
