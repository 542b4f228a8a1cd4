"""Command line: a coloured scan and photos in, camera poses out."""

from .command import Arguments, command
from .options import DESCRIPTION, EPILOG, add_arguments


@command(__file__, DESCRIPTION, EPILOG, add_arguments, "0 all localized, 1 some not", "piccolo.cli.photo_run")
def main(arguments: Arguments) -> int:
    """Localize every panorama, write the results, return the exit code."""
    from .photo_run import localize_photos  # noqa: PLC0415  # --help need not wait for it

    return localize_photos(arguments)
