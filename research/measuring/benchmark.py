"""Measure the method, write BENCHMARK.md, and fit the confidence."""

from argparse import ArgumentParser

from piccolo.cli.command import Arguments, add_command, command

from . import calibration, confidence, groups, page, sensitivity

EPILOG = """\
example:
  python tools/benchmark.py all --scenes datasets/stanford --out BENCHMARK.md

"""
MEASUREMENTS = {
    "all": page,
    "confidence": confidence,
    "groups": groups,
    "calibration": calibration,
    "sensitivity": sensitivity,
}


def add_arguments(parser: ArgumentParser) -> None:
    """Add a subcommand for each measurement."""
    subparsers = parser.add_subparsers(dest="measurement", required=True)
    for name, module in MEASUREMENTS.items():
        lines = {"help": module.__doc__, "description": module.__doc__, "epilog": module.EPILOG}
        module.add_arguments(add_command(subparsers, name, **lines))


@command(__file__, __doc__, EPILOG, add_arguments, "0 done, 1 confidence found a false answer")
def main(arguments: Arguments) -> int:
    """Run the measurement asked for; returns the exit code."""
    return int(MEASUREMENTS[arguments.measurement].run(arguments))
