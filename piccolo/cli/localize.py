"""Command line: a coloured scan and 360-degree photos in, camera poses out."""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from ..coarse_to_fine.settings import EngineSettings
from ..confidence.confidence import LOCALIZED
from ..errors import InputError
from ..panorama import ReadOptions
from ..paper.settings import PaperSettings
from ..pipeline import CachePolicy, Inputs, Localizer, localize_file, open_localizer
from ..render.overlay import overlay_png
from ..result import Result
from ..runtime.atomic import check_output, write_atomically
from ..runtime.jit import KERNEL_FOLDER, is_first_use
from ..runtime.stopwatch import Stopwatch
from ..runtime.threads import Workers
from .errors import EXIT_BAD_INPUT, checking_options, format_error, print_error, run_command
from .options import build_parser, check_arguments, cloud_settings_from, read_options_from, settings_from
from .progress import progress_bar, warn_once

EXIT_ALL_LOCALIZED, EXIT_SOME_NOT = 0, 1


@dataclass(frozen=True)
class Session:
    """One prepared cloud and how to treat the panoramas."""

    arguments: argparse.Namespace
    inputs: Inputs
    localizer: Localizer
    workers: Workers
    seconds: dict[str, float]  # spent once, on the cloud

    def say(self, text: str) -> None:
        """A line for the user, on stderr."""
        if not self.arguments.quiet:
            tqdm.write(text, file=sys.stderr)

    def localize(self, pano: Path) -> Result:
        """Read one panorama, localize it, write its overlay if one is asked for."""
        localizer = self.localizer
        result, panorama = localize_file(localizer, self.inputs, pano, self.workers, self.seconds)
        if self.arguments.overlay and result.pose is not None:
            png = overlay_png(localizer.points, panorama, localizer.from_world(result.pose), self.workers)
            write_atomically(self.arguments.overlay, png)
        for warning in panorama.warnings:
            self.say(f"warning: {warning}")
        return result


def open_session(
    arguments: argparse.Namespace, settings: EngineSettings | PaperSettings, read_options: ReadOptions
) -> Session:
    """Read and prepare the cloud, after a look at what is to be written."""
    for output in filter(None, (arguments.out, arguments.overlay)):
        check_output(output, [*arguments.cloud, *arguments.pano])
    if is_first_use() and not arguments.quiet:
        text = f"first use: compiling kernels, once (under half a minute), into {KERNEL_FOLDER}"
        print(text, file=sys.stderr, flush=True)

    watch = Stopwatch()
    cache = CachePolicy(not arguments.no_cache, arguments.cache)
    workers = Workers(arguments.threads, progress_bar(arguments.quiet), warn_once(arguments.quiet))
    inputs = Inputs(tuple(arguments.cloud), cloud_settings_from(arguments), read_options)
    localizer = open_localizer(inputs, settings, cache, workers, watch)
    for warning in localizer.warnings:  # those of a map prepared earlier; others have been written
        workers.warn(warning)
    return Session(arguments, inputs, localizer, workers, watch.seconds)


def results_of(session: Session) -> Iterator[Result | None]:
    """The result of each panorama in order; None for one that can't be read, after saying why."""
    arguments = session.arguments
    hidden = arguments.quiet or len(arguments.pano) == 1
    for pano in tqdm(arguments.pano, desc="panoramas", unit="", disable=hidden, file=sys.stderr):
        try:
            result = session.localize(pano)
        except (OSError, InputError) as error:
            print_error(arguments, format_error(error), EXIT_BAD_INPUT)
            yield None
            continue
        session.say(result.summary())
        yield result


def run(arguments: argparse.Namespace) -> int:
    """Localize every panorama, write the results, return the exit code."""
    with checking_options():
        check_arguments(arguments)
        settings, read_options = settings_from(arguments), read_options_from(arguments)
    session, lines = open_session(arguments, settings, read_options), list[str]()
    is_bad = some_not = False
    for result in results_of(session):
        is_bad |= result is None
        if result is None:
            continue
        some_not |= result.status != LOCALIZED
        if arguments.out:
            lines.append(result.to_json() + "\n")
        else:
            print(result.to_json(), flush=True)
    if arguments.out and lines:
        write_atomically(arguments.out, "".join(lines).encode())
    if is_bad:
        return EXIT_BAD_INPUT
    return EXIT_SOME_NOT if some_not else EXIT_ALL_LOCALIZED


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    return run_command(build_parser(), argv, run)
