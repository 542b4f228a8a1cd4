"""Photos of one place whose relative poses are not known, localized together.

Each photo is searched by itself. From each likely pose of a photo, the poses of the others follow by their
matches (`links`); these poses together are called a place of the group. The best places are tested in every
photo, and weighed as poses of a bundle are. Photos that do not belong to the best place may belong to
another. The others are searched near those that are sure (`unsure`); else each keeps its own result.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from hashlib import sha256
from typing import NamedTuple

import numpy as np

from ..geometry.nearness import ONE_IN_BUNDLE
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import LIKELY
from ..judge.by_others import Shares
from ..judge.probability import LOCALIZED
from ..judge.result import Result
from ..localization.means import Means
from ..problem.accuracy import Demand
from ..scan_map.scan_map import ScanMap
from ..system.arrays import Array
from ..system.jobs.threads import Stopwatch, Workers, one_blas_thread
from .bundle import EVEN_ODDS, judge_placed, place_between
from .bundle_search import NUM_BUNDLES, Support, find_supports, weigh_bundles
from .expected import locate_all
from .links import FIRM, WEAK, Links, Placed, Places, are_bridged, compute_new, find_links, spread
from .members import Grouped, Member, Shot, find_members
from .mirrored import refuse_mirrored
from .optima import widen_unsure
from .unsure import localize_rest

NUM_ANCHORS = 5  # poses of a photo from which a place of the group may follow, the likeliest
LEAST_LIKELY = 1e-3  # chosen: probability of a pose from which a place of the group may follow
MOST_SPREAD = 12  # places of the group that are tried
BELONGS_WEAKLY = 0.7  # chosen: probability that a photo belongs where few matches put it


class Group(NamedTuple):
    """Photos that may belong together."""

    links: Links
    members: Mapping[int, Member]  # by number


class Tested(NamedTuple):
    """A place of a group, tested in its photos."""

    places: Places
    supports: dict[int, Support]


@one_blas_thread()
def localize_group(
    scan_map: ScanMap, shots: Sequence[Shot], workers: Workers, watch: Stopwatch
) -> list[Grouped]:
    """Localize photos that may belong together, in any order; those that do not are localized alone.

    Their settings are alike, but for priors and traces.
    """
    contents = [sha256(shot.panorama.rgb.tobytes()).digest() for shot in shots]
    order = sorted(range(len(shots)), key=contents.__getitem__)  # results do not depend on the order given
    alone, members, asked = find_members(scan_map, [shots[k] for k in order], workers, watch)
    grouped = {k: Grouped(one, ()) for k, one in enumerate(alone)}
    matched = {k: one for k, one in members.items() if one.found.problem.profile.uses_matches}
    if matched:
        settings = shots[0].settings
        with watch.stage("refine"):
            means = Means(settings.effort, workers, watch)
            grouped |= localize_linked(matched, means, settings.demand)
            grouped |= localize_rest(scan_map, asked, {k: grouped[k] for k in matched}, means)
    return [
        Grouped(grouped[k].result, tuple(sorted(order[other] for other in grouped[k].others)))
        for k in np.argsort(order)
    ]


def localize_linked(members: Mapping[int, Member], means: Means, demand: Demand) -> dict[int, Grouped]:
    """Return the results of those photos that are localized together, by their numbers."""
    links = find_links({k: member.found.problem for k, member in members.items()}, means.workers)
    group = Group(links, members)
    grouped: dict[int, Grouped] = {}
    for numbers in links.list_groups():
        left = set(numbers)
        while proposed := propose_places(group, left):
            tested, probabilities = weigh_places(group, proposed, left, means)
            grouped |= {k: Grouped(one, ()) for k, one in doubt_sure(group, tested, demand).items()}
            found: dict[int, Result] = {}
            if probabilities[0] >= EVEN_ODDS:
                found = judge_group(group, tested, probabilities, means, demand)
            for k, result in found.items():
                grouped[k] = Grouped(result, tuple(other for other in found if other != k))
            left -= found.keys() or tested[0].places.keys()
        linked = {k: grouped.get(k, Grouped(members[k].alone, ())) for k in numbers}
        results = {k: one.result for k, one in linked.items()}
        others = {k: one.others for k, one in linked.items()}
        refused = refuse_mirrored(results, others, members, demand.min_confidence)
        grouped |= {k: Grouped(result, ()) for k, result in refused.items()}
    return grouped


def propose_places(group: Group, numbers: Collection[int]) -> list[Places]:
    """Return places of two and more photos, those with the most votes of the photos' own poses first."""
    own = [
        (-probability, number, candidate.pose)
        for number in sorted(numbers)
        for candidate, probability in group.members[number].own_poses[:NUM_ANCHORS]
        if probability > LEAST_LIKELY
    ]
    found: list[Places] = []
    for _, number, pose in sorted(own, key=lambda one: one[:2]):
        is_known = any(number in one and ONE_IN_BUNDLE.holds(one[number].pose, pose) for one in found)
        if not is_known and len(found) < MOST_SPREAD:
            anchor = {number: group.links.place(number, pose)}
            found.append(spread(group.links, anchor, numbers, FIRM))
    settled = [settle_group(group, places, numbers) for places in join_bridged(group.links, found)]
    kept: list[Places] = []
    for places in sorted(settled, key=lambda places: -count_votes(group, places)):
        if len(places) > 1 and not any(is_same_place(places, other) for other in kept):
            kept.append(places)
    return kept[:NUM_BUNDLES]


def join_bridged(links: Links, found: Sequence[Places]) -> list[Places]:
    """Join places that have no photo in common, if matches between their photos agree with both."""
    joined: list[Places] = []
    for places in found:
        bridged = next((k for k, other in enumerate(joined) if are_bridged(links, places, other)), None)
        if bridged is None:
            joined.append(places)
        else:
            joined[bridged] = {**joined[bridged], **places}
    return joined


def is_same_place(one: Places, other: Places) -> bool:
    """Return True if two places have photos in common, all at the same poses."""
    common = one.keys() & other.keys()
    return bool(common) and all(ONE_IN_BUNDLE.holds(one[k].pose, other[k].pose) for k in common)


def find_own(member: Member, pose: Pose) -> tuple[Pose, float]:
    """Return a photo's own pose near another, and its probability; the other, and 0, if it has none."""
    near = (one for one in member.own_poses if ONE_IN_BUNDLE.holds(one[0].pose, pose))
    return next(((candidate.pose, probability) for candidate, probability in near), (pose, 0.0))


def count_votes(group: Group, places: Places) -> float:
    """Return the sum of the probabilities of the photos' own poses where they are placed."""
    return sum(find_own(group.members[k], placed.pose)[1] for k, placed in places.items())


def settle_group(group: Group, places: Places, numbers: Collection[int]) -> Places:
    """Place the photos again, from the photos whose likely own poses are where they are expected."""
    own = {k: find_own(group.members[k], placed.pose) for k, placed in places.items()}
    anchors = {
        k: group.links.place(k, pose) for k, (pose, probability) in own.items() if probability > EVEN_ODDS
    }
    return spread(group.links, anchors, numbers, FIRM) if anchors else places


def weigh_places(
    group: Group, proposed: Sequence[Places], numbers: Collection[int], means: Means
) -> tuple[list[Tested], Array]:
    """Test the best place, and those that put some of its photos elsewhere; return them, the likeliest first.

    Return also the probabilities (K + 1,) of these places, and of none, by all photos that have a pose in any
    of the places.
    """
    rivals = [places for places in proposed[1:] if places.keys() & proposed[0].keys()]
    tested = examine_places(group, [proposed[0], *rivals], numbers, means)
    every = sorted({number for one in tested for number in one.supports})
    missed = {k: next(one.supports[k] for one in tested if k in one.supports).miss() for k in every}
    supports = [[one.supports.get(k, missed[k]) for k in every] for one in tested]
    probabilities = weigh_bundles(supports, [group.members[k] for k in every])
    order = np.argsort(-probabilities[:-1], kind="stable")
    return [tested[k] for k in order], np.append(probabilities[order], probabilities[-1])


def examine_places(
    group: Group, proposed: Sequence[Places], numbers: Collection[int], means: Means
) -> list[Tested]:
    """Test places in each of their photos, and in photos that only a few matches put there."""
    tested = [Tested(spread(group.links, places, numbers, WEAK), {}) for places in proposed]
    for number in sorted({number for one in tested for number in one.places}):
        member = group.members[number]
        at = [k for k, one in enumerate(tested) if number in one.places]
        expected = [tested[k].places[number].pose for k in at]
        found = find_supports(member, member.found.problem.forget(), expected, means.workers)
        for k, support in zip(at, found, strict=True):
            belongs = support.belongs if number in proposed[k] else BELONGS_WEAKLY
            tested[k].supports[number] = support._replace(belongs=belongs)
    return weigh_supports(group.links, tested)


def weigh_supports(links: Links, tested: Sequence[Tested]) -> list[Tested]:
    """Weigh the evidence of photos for places: what several show counts once, by the photo that shows most.

    A photo has the same weight for each place, so that places are compared by the same evidence.
    """
    of_places = [weigh_at(links, one) for one in tested]

    def weigh(number: int, support: Support) -> Support:
        of_photo = [weights[number] for weights in of_places if number in weights]
        return support._replace(weight=sum(of_photo) / len(of_photo))

    return [one._replace(supports={k: weigh(k, s) for k, s in one.supports.items()}) for one in tested]


def weigh_at(links: Links, tested: Tested) -> dict[int, float]:
    """Return the weights of the photos at one place: the shares that no photo with more odds shows."""
    counted: dict[int, Placed] = {}
    weights: dict[int, float] = {}
    for number in sorted(tested.supports, key=lambda k: (-tested.supports[k].odds, k)):
        counted[number] = tested.places[number]
        weights[number] = compute_new(links, counted, number)
    return weights


def doubt_sure(group: Group, tested: Sequence[Tested], demand: Demand) -> dict[int, Result]:
    """Return the results of photos that were sure alone, but explain a place elsewhere better."""
    doubted = {}
    for number in sorted({number for one in tested for number in one.supports}):
        member = group.members[number]
        supports = [one.supports[number] for one in tested if number in one.supports]
        here = max((s.odds for s in supports if member.is_best(s.own.pose)), default=math.inf)
        there = max((s.odds for s in supports if not member.is_best(s.own.pose)), default=0.0)
        if member.alone.status == LOCALIZED and there > here:
            belief = member.alone.belief.scale(here / (here + there))
            doubted[number] = member.alone.take_belief(belief, demand.min_confidence)
    return doubted


def judge_group(
    group: Group, tested: Sequence[Tested], probabilities: Array, means: Means, demand: Demand
) -> dict[int, Result]:
    """Return the results of the photos that belong to the first of several places of their group.

    There are no results if only one photo belongs to it, and no other photo is sure to have been taken there.
    """
    best, *elsewhere = tested
    supports = widen_unsure(group.members, best.supports, means.workers)
    own, expected = locate_all(group.links, best.places, supports)
    results = {}
    for number, support in supports.items():
        member = group.members[number]
        belongs = Shares(*support.shares[:2].tolist())
        is_sure = member.alone.status == LOCALIZED
        of_others = expected.get(number)
        if is_sure and of_others and number in own and own[number].square_distance(of_others) > LIKELY:
            of_others = None  # a pose by few matches does not count against a sure one
        placed = place_between(belongs, own.get(number), of_others)
        is_refused = bool(member.alone.belief.ruled_out) and not member.is_misplaced
        is_own = member.is_best(support.own.pose) and placed.shares.right >= placed.shares.missed
        if is_refused or placed.gaussian is None or belongs.here < EVEN_ODDS:
            continue
        if is_sure and not is_own:  # others do not move a pose that is sure alone
            continue
        others = [k for k, one in enumerate(elsewhere) if number in one.places]
        poses = [elsewhere[k].places[number].pose for k in others]
        of_places = probabilities[[0, *(k + 1 for k in others)]]
        of_all = np.append(of_places, 1.0 - of_places.sum())
        result = judge_placed(member, support, placed, number in own, poses, of_all, means, demand)
        if result.status == LOCALIZED or not is_sure:
            results[number] = result
    return results if len(results.keys() | list_sure(group, best)) > 1 else {}


def list_sure(group: Group, tested: Tested) -> set[int]:
    """List the photos that were sure alone of where a place of their group puts them."""
    sure = {k for k in tested.supports if group.members[k].alone.status == LOCALIZED}
    return {k for k in sure if group.members[k].is_best(tested.supports[k].own.pose)}
