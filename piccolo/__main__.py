"""`python -m piccolo` is the command piccolo-localize."""

import sys

from .cli.start import run

sys.argv[0] = "piccolo-localize"  # by which messages name it
sys.exit(run("piccolo.cli.localize"))
