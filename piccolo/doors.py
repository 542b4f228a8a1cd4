"""The commands that an installation has, each named after a script of the checkout.

`piccolo.doors.NAME` is a function without arguments that runs the command NAME, for console commands.
"""

from collections.abc import Callable
from functools import partial

from .cli.start import run

# The module of each command, whose `main` it runs: piccolo-NAME where it is installed.
COMMANDS = {
    "localize": "piccolo.cli.localize",
    "prepare_map": "piccolo.cli.prepare_map",
    "align_gravity": "piccolo.apps.align_gravity",
    "align_model": "piccolo.apps.models.align_model",
    "calibrate_mount": "piccolo.apps.mount.calibrate_mount",
    "color_scan": "piccolo.apps.color_scan",
    "e57_images": "piccolo.apps.e57_images",
    "export_poses": "piccolo.apps.export.export_poses",
    "render_pose": "piccolo.apps.render_pose",
    "report": "piccolo.apps.report.report",
    "serve": "piccolo.apps.service.serve",
}


def __getattr__(name: str) -> Callable[[], int]:
    """Return a function that runs the command `name`."""
    if name not in COMMANDS:
        raise AttributeError(f"piccolo has no command {name!r}")
    return partial(run, COMMANDS[name])
