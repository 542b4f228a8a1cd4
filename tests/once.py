"""Photos that several tests localize are searched by themselves once for all tests of a module."""

import pickle

from piccolo.api import scan_photo
from piccolo.together import among, members


def _content(panorama):
    """All that is known of a picture and its camera."""
    return pickle.dumps(panorama)


def _points(prepared):
    """What tells a scan from others: maps that tests make have no digest."""
    return prepared.points.stack().tobytes()


def _share(patch, owner, name, key):
    """Let a function compute once for each key of its arguments."""
    known = {}
    compute = getattr(owner, name)

    def ask(*given):
        asked = key(*given)
        if asked not in known:
            known[asked] = compute(*given)
        return known[asked]

    patch.setattr(owner, name, ask)


def search_alone_once(patch, is_per_threads=True):
    """Share what photos find by themselves, for each number of threads unless that is not the subject.

    A search whose steps are noted is not shared.
    """

    def alone(scan_map, shot, workers, _, before=None):
        traced = object() if shot.trace.is_wanted else None
        known = before and tuple(one.pose.key for one in before.found.selection.candidates)
        photo = (_content(shot.panorama), shot.settings, known)
        return _points(scan_map), photo, workers.num_threads if is_per_threads else None, traced

    for owner in (members, among):
        _share(patch, owner, "find_alone", alone)


def search_photos_once(patch):
    """Let photos be read as often as they are asked for, but each be searched once.

    That is for each scan, by its points, and for all settings.
    """

    def search(prepared, picture, settings, *means):
        workers = means[0] if len(means) > 1 else means[0].workers
        assert len(means) > 1 or not means[0].trace.is_wanted, "the steps of each search"
        return _points(prepared), _content(picture), settings, workers.num_threads

    for name in ("localize", "localize_by_paper"):
        _share(patch, scan_photo, name, search)
