"""Photos of a group that are not sure, searched near those that are, in rounds.

Those that are sure of their place help to find the others, and who is found by them helps in the next round.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..geometry.pose_gaussian import PoseGaussian
from ..judge.conclude import take_pose
from ..judge.probability import LOCALIZED
from ..judge.result import Result
from ..localization.means import Means
from ..problem.accuracy import Demand
from ..scan_map.scan_map import ScanMap
from .at_spot import average_each
from .members import Grouped, Shot
from .nearby import Searched, Witness, doubt_stray, localize_nearby, search_nearby, take_poses
from .spot import LEAST_AT_SPOT, gather

NUM_REST_ROUNDS = 3  # in which photos that were found near others help to find further ones


def localize_rest(
    scan_map: ScanMap, shots: Sequence[Shot], grouped: Mapping[int, Grouped], means: Means
) -> dict[int, Grouped]:
    """Return the results of photos near where others were taken: of those not sure that are found there.

    Those that are sure of their place help to find the others. A photo that is sure of another place is
    doubted. Poses of photos that were sure before are averaged with where the others were taken.
    """
    results = {k: one.result for k, one in grouped.items()}
    sure = {k: one for k, one in results.items() if one.status == LOCALIZED}
    witnesses = {k: find_witness(one, shots[k].settings.demand) for k, one in results.items()}
    located = {k: one for k, one in witnesses.items() if one is not None}
    strays = [k for k in list_strays(located) if not grouped[k].others]
    located = {k: one for k, one in located.items() if k not in strays}
    rest, located = find_near_others(scan_map, shots, results, located, means)
    known = list(located.values())
    for k in strays:
        if k in sure and known:
            doubted = doubt_stray(scan_map, shots[k], sure[k], known, len(strays) - 1, means)
            rest[k] = Grouped(doubted, tuple(located))
    for k, mean in zip(located, average_each([one.gaussian for one in known]), strict=True):
        if k in sure:
            averaged = take_average(sure[k], mean, scan_map, shots[k].settings.demand)
            rest[k] = grouped[k]._replace(result=averaged)
    return rest


def find_near_others(
    scan_map: ScanMap,
    shots: Sequence[Shot],
    results: Mapping[int, Result],
    located: Mapping[int, Witness],
    means: Means,
) -> tuple[dict[int, Grouped], dict[int, Witness]]:
    """Search the photos that are not localized near those that are sure of their place, in rounds.

    Return the results of those that were found, and all that are sure of their place then.
    """
    rest: dict[int, Grouped] = {}
    searched: dict[int, Searched] = {}
    located = dict(located)
    left = [k for k, one in results.items() if one.status != LOCALIZED]
    for _ in range(NUM_REST_ROUNDS):
        joined: dict[int, Witness] = {}
        for k in left:
            others = {n: one for n, one in located.items() if n != k}
            witnesses = list(others.values())
            near = take_poses(witnesses)
            looked = search_nearby(scan_map, shots[k], near, means, searched.get(k)) if near else None
            if looked is None:
                continue
            searched[k] = looked.forget()
            demand = shots[k].settings.demand
            found = localize_nearby(scan_map, looked, results[k], witnesses, means, demand)
            if found is None:
                continue
            rest[k] = Grouped(found.result, tuple(others))
            if found.result.status == LOCALIZED and found.held.alone:
                joined[k] = Witness(found.held.alone, found.result.belief.best_place)
        if not joined:
            break
        located |= {k: one for k, one in joined.items() if k not in located}
        left = [k for k in left if k not in joined]
    return rest, located


def find_witness(result: Result, demand: Demand) -> Witness | None:
    """Return what a photo that is sure of its place, exactly or not, tells others; None if it is not sure."""
    if result.gaussian is None or result.belief.sound_places[0] < demand.min_confidence:
        return None
    return Witness(result.gaussian, float(result.belief.sound_places[0]))


def list_strays(located: Mapping[int, Witness]) -> list[int]:
    """List the photos that were taken at no spot, if others were."""
    numbers = list(located)
    groups = gather([one.gaussian.pose for one in located.values()])
    if max(map(len, groups), default=0) < LEAST_AT_SPOT:
        return []
    return [numbers[k] for group in groups if len(group) < LEAST_AT_SPOT for k in group]


def take_average(result: Result, mean: PoseGaussian, scan_map: ScanMap, demand: Demand) -> Result:
    """Return the result of a sure photo with its pose averaged with where others were taken."""
    if mean is result.gaussian:
        return result
    within = max(demand.accuracy.probability(mean), result.belief.within)
    belief = replace(result.belief, within=within)
    return take_pose(result, mean, scan_map).take_belief(belief, demand.min_confidence)
