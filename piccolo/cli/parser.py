"""Parsers of the command lines: names as the user started them, and the options that all commands have."""

import argparse
import re
import sys
from pathlib import Path

# those that are installed as console commands too: piccolo-localize, piccolo-make-room ...
COMMANDS = (
    "localize", "align_gravity", "prepare_map", "render_pose", "export_poses", "report", "e57_images",
    "make_room", "convert_dataset", "evaluate", "reproduce_paper", "loss_surface",
)  # fmt: skip
SCRIPT = re.compile(rf"(?:python )?(?:tools/)?\b({'|'.join(COMMANDS)})\.py\b")


def as_started(text: str) -> str:
    """`text`, which names commands as scripts, with the names of console commands if one was started."""
    if not Path(sys.argv[0]).name.startswith("piccolo-"):
        return text
    return SCRIPT.sub(lambda match: f"piccolo-{match[1].replace('_', '-')}", text)


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Prints the epilog as it stands, and the names of commands as they were started."""

    def format_help(self) -> str:
        """The usage or the whole help."""
        return as_started(super().format_help())


def new_parser(
    name: str, description: str | None, epilog: str, exit_codes: str = "0 done"
) -> argparse.ArgumentParser:
    """A parser of the command `name` without options; run_command needs those of add_run_options too.

    `exit_codes` are those of the command itself, below 2.
    """
    program = as_started(f"{name}.py")
    epilog += f"exit codes: {exit_codes}, 2 wrong usage, 3 bad input, 4 internal error, "
    epilog += "130 interrupted, 143 terminated."
    parser = argparse.ArgumentParser(
        program, description=description, epilog=epilog, formatter_class=HelpFormatter
    )
    parser.set_defaults(program=program)
    return parser


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """--quiet and --debug."""
    parser.add_argument("--quiet", action="store_true", help="nothing on stderr but errors")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")


def parse(parser: argparse.ArgumentParser, argv: list[str] | None) -> argparse.Namespace:
    """The options given; argparse alone would take the value of `--up -y` for an option."""
    words: list[str] = []
    for word in sys.argv[1:] if argv is None else argv:
        if words[-1:] == ["--up"]:
            words[-1] = f"--up={word}"
        else:
            words.append(word)
    return parser.parse_args(words)
