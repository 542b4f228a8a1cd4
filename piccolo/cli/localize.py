"""Command line: a coloured scan and photos in, camera poses out."""

from .command import command
from .options import DESCRIPTION, EPILOG, add_arguments

main = command(__file__, DESCRIPTION, EPILOG, add_arguments, "0 all localized, 1 some not")(
    "piccolo.cli.photo_run:localize_photos"
)
