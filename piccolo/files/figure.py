"""Figures by matplotlib, which is imported when the first is drawn: it takes half a second."""

from typing import TYPE_CHECKING, Any

from ..optional import import_optional

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(**options: Any) -> "Figure":
    """An empty figure that belongs to no window; options as matplotlib's Figure takes them."""
    figure: Figure = import_optional("a plot", "matplotlib.figure", "tools").Figure(**options)
    return figure
