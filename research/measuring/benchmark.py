"""Measure the method, write BENCHMARK.md, and fit the confidence."""

from argparse import ArgumentParser, Namespace

from piccolo.cli.command import HelpFormatter, add_run_options, command

from . import calibration, confidence, page, sensitivity

EPILOG = """\
example:
  python tools/benchmark.py all --scenes datasets/stanford --out BENCHMARK.md

"""
MEASUREMENTS = {
    "all": page,
    "confidence": confidence,
    "calibration": calibration,
    "sensitivity": sensitivity,
}


def add_arguments(parser: ArgumentParser) -> None:
    """Add a subcommand for each measurement."""
    subparsers = parser.add_subparsers(dest="measurement", required=True)
    for name, module in MEASUREMENTS.items():
        lines = {"help": module.__doc__, "description": module.__doc__, "epilog": module.EPILOG}
        subparser = subparsers.add_parser(name, formatter_class=HelpFormatter, **lines)
        module.add_arguments(subparser)
        add_run_options(subparser)


@command(__file__, __doc__, EPILOG, add_arguments, "0 done, 1 confidence found a false answer")
def main(arguments: Namespace) -> int:
    """Run the measurement asked for; returns the exit code."""
    return int(MEASUREMENTS[arguments.measurement].run(arguments))
