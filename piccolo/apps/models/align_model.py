"""Move a model of structure from motion onto the scan, with scale."""

from argparse import ArgumentParser

import numpy as np

from ...api.result_files import read_results
from ...cli.command import Arguments, check_distinct, command, option
from ...geometry.pose import quaternion_wxyz
from ...system.files.atomic import check_output, check_output_folder
from .model_alignment import file_of_poses, fit_alignment, write_aligned, write_matrix

EPILOG = """\
example:
  python localize.py --cloud scan.ply --pano photos --relative sparse/0/images.bin --out poses.jsonl
  python tools/align_model.py --model sparse/0 --results poses.jsonl --out aligned

The photos are localized together first, by the poses that the model gives them relative to each other;
three or more that are localized decide. The whole model moves: cameras, poses and points (COLMAP, OpenSfM),
or the transform of the chunk (Metashape, whose coordinates become local). Dense clouds and meshes in the
model's coordinates are moved by the matrix, as in CloudCompare (Edit > Apply transformation); those that
Metashape has exported are in others: import its cameras and export again.

Prints one JSON object: x_scan = scale R x_model + translation, with R = R_scan_from_model as a quaternion;
the same as T_scan_from_model, rows of a 4x4 matrix; standard deviations; how far half and nine tenths of
the photos are from where the model puts them (null if they were localized by it: then localize some alone
to know it); and the photos that contradict the others. A model of one place has no scale and is refused.
"""
SHARES = 0.5, 0.9  # of the photos
DEPENDENT = (
    "the photos' poses are its own, as by --relative: how far they are from where it puts them says nothing; "
    "to know it, localize photos without"
)


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    text = "folder of COLMAP's model, Metashape's cameras.xml (File > Export > Cameras), or OpenSfM's "
    text += "reconstruction.json; without --out also JSON of OpenMVG or Meshroom"
    option(parser, "--model FILE", text, required=True)
    option(parser, "--results FILE ...", "results of localize.py, JSON lines", required=True)
    option(parser, "--out FILE", "the model in the scan's coordinates: a new folder, .xml or .json")
    option(parser, "--matrix FILE", "write the 4x4 matrix T_scan_from_model as text")


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Read, fit, write; returns the exit code."""
    outputs = {"--out": arguments.out, "--matrix": arguments.matrix}
    check_distinct(outputs, [*arguments.results, file_of_poses(arguments.model)])
    if arguments.out:
        (check_output_folder if arguments.model.is_dir() else check_output)(arguments.out)
    if arguments.matrix:
        check_output(arguments.matrix)
    fit = fit_alignment(arguments.model, read_results(arguments.results))
    if arguments.out:
        write_aligned(arguments.model, fit, arguments.out)
    if arguments.matrix:
        write_matrix(fit, arguments.matrix)
    norms = [np.linalg.norm(part, axis=1) for part in np.split(fit.steps, 2, axis=1)]
    turned, moved = (np.quantile(norm, SHARES) for norm in norms)
    if not fit.is_independent:
        arguments.warn([f"{arguments.model}: {DEPENDENT}"])
    report = {
        "out": arguments.out and str(arguments.out),
        "scale": fit.scale,
        "std_scale": fit.scale * float(fit.std[6]),
        "quaternion_wxyz_scan_from_model": quaternion_wxyz(fit.R_scan_from_model).tolist(),
        "std_deg": np.degrees(fit.std[:3]).tolist(),
        "translation_m": fit.translation.tolist(),
        "std_m": fit.std[3:6].tolist(),
        "T_scan_from_model": fit.T_scan_from_model.tolist(),
        "photos": len(fit.steps),
        "off_deg": np.degrees(turned).tolist() if fit.is_independent else None,
        "off_m": moved.tolist() if fit.is_independent else None,
        "contradicting": list(fit.contradicting),
    }
    arguments.report(outputs, report)
    return 0
