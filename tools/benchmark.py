#!/usr/bin/env python3
"""Measure the method: its kernels, its parts, time and memory by size, and how far its confidences hold."""

import argparse
import sys

import _checkout  # noqa: F401
from measuring import ablation, calibration, confidence, kernels, scaling

from piccolo.cli.command import HelpFormatter, add_run_options, command

MODULES = kernels, scaling, ablation, confidence, calibration
MEASUREMENTS = {module.__name__.rpartition(".")[2]: module for module in MODULES}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A subcommand a measurement."""
    subparsers = parser.add_subparsers(dest="measurement", required=True)
    for name, module in MEASUREMENTS.items():
        lines = {"help": module.__doc__, "description": module.__doc__, "epilog": module.EPILOG}
        subparser = subparsers.add_parser(name, formatter_class=HelpFormatter, **lines)
        module.add_arguments(subparser)
        add_run_options(subparser)


@command(__file__, __doc__, "", add_arguments, "0 done, 1 a false answer")
def main(arguments: argparse.Namespace) -> int:
    """Run the measurement asked for; returns the exit code."""
    return int(MEASUREMENTS[arguments.measurement].run(arguments))


if __name__ == "__main__":
    sys.exit(main())
