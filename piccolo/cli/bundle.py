"""localize.py --relative: photos with known poses relative to each other, localized as one camera."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from ..batch.localizer import Localizer
from ..batch.relative_poses import find_scale, read_relative_poses
from ..files.line_file import Journal
from ..opened_scan import OpenedScan
from ..panorama.photo import sha256_of
from ..result import Result
from .command import check_alone
from .together import Job, Report

NOT_WITH = ("walk", "video", "jobs", "dask", "overlay", "occlusion_mask", "priors", "refine_focal")


def check_bundle_options(arguments: argparse.Namespace) -> None:
    """Refuse options that do not go with --relative."""
    if arguments.relative:
        check_alone(arguments, "--relative", NOT_WITH)


def make_bundle_job(
    arguments: argparse.Namespace,
    photos: Sequence[Path],
    localizer: Localizer,
    scan: OpenedScan,
    print_result: Callable[[Result, Sequence[str]], None],
) -> Job:
    """Return the job of localizing photos as one camera; a stopped one begins again."""
    poses = read_relative_poses(arguments.relative, photos)
    more = {"relative_sha256": sha256_of(arguments.relative, None)}
    given = {str(path): localizer.ask(path)[0] for path in photos}
    fields = localizer.expect(scan.prepared.scan_sha256, more)

    def run(_journal: Journal) -> list[Result]:
        scale = find_scale(arguments.relative)
        found = scan.localize_bundle([localizer.ask(p)[0] for p in photos], poses, localizer.settings, scale)
        return [replace(result, settings={**result.settings, **more}) for result in found]

    def report(results: Sequence[Result]) -> Report:
        for result in results:
            print_result(result, result.warnings[len(scan.warnings) :])
        return Report("")

    return Job("photos together", given, fields, run, report)
