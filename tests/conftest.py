"""Every result that a test makes, or that a command writes for it, is checked (consistency.py)."""

import os
import signal
import threading

import pytest
import rooms
import tiers
from batches import COARSE
from consistency import contradictions_of_line, find_contradictions, lines_of_results
from hypothesis import settings
from once import search_alone_once, search_photos_once

from piccolo.cloud.readers import e57, las, mesh, reader, text
from piccolo.judge.result import Result
from piccolo.system.files import cache
from piccolo.system.jobs.memory import limit_memory
from piccolo.system.kernels import jit
from piccolo.together.coloring import alignment, passersby

# A shell starts what runs in the background with Ctrl-C ignored, as then would be what a test starts.
signal.signal(signal.SIGINT, signal.default_int_handler)


# How long an example takes says how busy the machine is, and if something was compiled.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")

# The files that take longest begin first, so that in the end no worker waits for another. Before them one
# worker runs what compiles most kernels, and the other what needs none, so that none is compiled twice.
SLOWEST = (
    "test_documents.py", "test_panorama_formats.py", "test_cloud_damage.py", "test_cloud_e57.py",
    "test_tools.py", "test_three_doors.py", "test_group_command.py", "test_service.py", "test_shape.py",
    "test_walk.py", "test_bundle.py", "test_group.py", "test_killed.py", "test_focal_length.py",
    "test_localization.py", "test_coloring.py", "test_batch.py", "test_attempts.py", "test_scan_formats.py",
    "test_report.py", "test_doors.py", "test_batch_second_look.py", "test_cluster.py", "test_jobs.py",
    "test_localize.py", "test_verification.py", "test_start.py", "test_align_gravity.py",
    "test_service_connections.py", "test_scan_addition.py", "test_service_access.py",
    "test_localize_cameras.py", "test_camera_tools.py",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    order = {name: number for number, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))
    for item in items:
        tier = tiers.tier_of(item)
        if not item.get_closest_marker(tier):
            item.add_marker(tier)


@pytest.fixture(autouse=True, scope="session")
def needed():
    """The tiers that what was done needed, since they were last taken out."""
    with pytest.MonkeyPatch.context() as patch:
        yield tiers.watch(patch)


@pytest.fixture(autouse=True)
def _tier(request, needed):
    """Fail a test that uses more than its tier may."""
    yield
    most = max(map(tiers.TIERS.index, needed), default=0)
    needed.clear()
    told = tiers.tier_of(request.node)
    assert most <= tiers.TIERS.index(told), f"found a {told} test that needs the tier {tiers.TIERS[most]}"


@pytest.fixture(autouse=True, scope="session")
def contradictions():
    """What contradicts itself in results that are made or written, since it was last taken out."""
    found = []
    make = Result.__post_init__
    write = Result.to_json
    is_checking = threading.local()

    def make_and_check(result):
        make(result)
        found.extend(f"{result.pano}: {words}" for words in find_contradictions(result))

    def write_and_check(result):
        text = write(result)
        if not vars(is_checking):  # which reads and writes too
            is_checking.now = True
            found.extend(f"{result.pano}: {words}" for words in contradictions_of_line(text))
            del is_checking.now
        return text

    patch = pytest.MonkeyPatch()
    patch.setattr(Result, "__post_init__", make_and_check)
    patch.setattr(Result, "to_json", write_and_check)
    yield found
    patch.undo()


@pytest.fixture(autouse=True)
def _consistent(request, contradictions):
    """Fail a test whose results contradict themselves, also those in files, maybe of other processes."""
    yield
    folder = request.node.funcargs.get("tmp_path")
    for line in lines_of_results(folder) if folder else ():
        contradictions.extend(contradictions_of_line(line))
    found = list(dict.fromkeys(contradictions))
    contradictions.clear()
    assert not found, "\n".join(found)


@pytest.fixture(autouse=True, scope="session")
def _shared_folder(tmp_path_factory):
    """The temporary folder of the run, above that of the worker if there are several."""
    folder = tmp_path_factory.getbasetemp()
    rooms.SHARED[:] = [folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder]


@pytest.fixture
def read_by(monkeypatch):
    """Let files of points be read in chunks of so many points, and those of text in so many bytes."""

    def shrink(num_points, num_bytes=text.BYTES_AT_ONCE):
        for module in (reader, las, e57, mesh):
            monkeypatch.setattr(module, "POINTS_A_CHUNK", num_points)
        monkeypatch.setattr(text, "BYTES_AT_ONCE", num_bytes)

    return shrink


@pytest.fixture
def home_cache(tmp_path, monkeypatch):
    """The user's folder for what is kept between runs, empty, and trusted or not as it is found then."""
    found = (cache.cache_root, cache.private_folder, jit.kernel_folder, jit.warn_not_kept, jit.warn_damaged)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    for each in found:
        each.cache_clear()
    yield tmp_path / "home" / "piccolo"
    for each in found:
        each.cache_clear()


@pytest.fixture
def limiting():
    """Set the memory [GB] that this process may take, until the test ends."""
    yield limit_memory
    limit_memory(None)


@pytest.fixture(scope="module")
def coarse_colors():
    """Photos that colour a scan are compared by fewer points and pixels, which is enough for a room."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (alignment, passersby):
            for name, value in COARSE[module.__name__.rpartition(".")[2]].items():
                patch.setattr(module, name, value)
        yield


@pytest.fixture(scope="module")
def searched_once():
    """A photo is searched once for all tests of a module, as often as it is read."""
    with pytest.MonkeyPatch.context() as patch:
        search_photos_once(patch)
        search_alone_once(patch)
        yield


@pytest.fixture(scope="session")
def scene():
    """A room's cloud and three panoramas, in a folder with a blank in its name; only to be read."""
    words = "--seed 7 --points 60000 --panoramas 3 --width 512"
    return rooms.make_once("a scene", lambda folder: rooms.write_room(folder, words))
