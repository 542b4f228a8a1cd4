"""Write the true poses of scenes as results of localize.py, or those of an aligned scan beside it."""

from argparse import ArgumentParser
from dataclasses import replace

from piccolo import InputError, Result
from piccolo.cli.command import Arguments, check_outputs, check_suffix, checking_options, command, option
from piccolo.geometry.pose import move
from piccolo.judge.probability import LOCALIZED
from piccolo.system.files.atomic import write_lines

from ..scene import QUERIES_NAME, Scene, find_scenes, input_files, write_queries
from .model import read_matrix

EPILOG = """\
examples:
  python tools/true_poses.py --scenes raw --out true.jsonl
  python tools/export_poses.py --results true.jsonl --format colmap --images raw --out model
  python tools/true_poses.py --scenes raw --transform aligned/cloud.txt --out aligned/queries.json

The lines are those of photos localized beyond doubt, for all tools that take --results. --transform is the
file that tools/align_gravity.py has written beside an aligned cloud of one scene.
"""


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    option(parser, "--scenes FOLDER ...", "scenes with true poses (research/DATASETS.md)", required=True)
    option(parser, "--transform FILE", "write the queries.json of a scene under this transform")
    option(parser, "--metres-per-unit X", "unit of the transform's translation [m]", default=1.0)
    option(parser, "--out FILE", "JSON lines; with --transform a queries.json", required=True)


def true_results(scene: Scene) -> list[Result]:
    """Return true poses of a scene, as if they had been found beyond doubt."""
    cloud = str(scene.cloud)
    return [
        Result(LOCALIZED, 1.0, cloud, str(query.image), query.pose, cameras=query.cameras)
        for query in scene.queries
    ]


def write_moved(arguments: Arguments, scene: Scene) -> None:
    """Write a scene's queries in the coordinates of the cloud beside the transform."""
    T = read_matrix(arguments.transform, 4)
    moved = [replace(q, pose=move(q.pose, T, arguments.metres_per_unit)) for q in scene.queries]
    write_queries(arguments.out.parent, moved, cloud=arguments.transform.with_suffix(".ply").name)


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Read and write."""
    with checking_options():
        if arguments.transform and arguments.out.name != QUERIES_NAME:
            raise InputError(f"--out {arguments.out}: wanted a file {QUERIES_NAME} with --transform")
        check_suffix("--out", arguments.out, (".jsonl", ".json"))
    scenes = find_scenes(arguments.scenes)
    check_outputs({"--out": arguments.out}, input_files(scenes))
    if arguments.transform:
        if len(scenes) > 1:
            raise InputError(f"--transform: found {len(scenes)} scenes, wanted one")
        write_moved(arguments, scenes[0])
    else:
        write_lines(arguments.out, [r.to_json() for scene in scenes for r in true_results(scene)])
    return 0
