import itertools

import numpy as np
import pytest

from piccolo.errors import InputError
from piccolo.geometry.pose import Pose
from piccolo.walk.frames import (
    COPY_LOG_ODDS,
    OTHER_LOG_ODDS,
    Frame,
    Motion,
    State,
    check_times,
    state_centers,
)
from piccolo.walk.path import (
    LEAST_TOLD,
    TELLING_LOG,
    UNLISTED,
    build_lattice,
    emissions,
    fraction_moved,
    log_entering,
    log_leaving,
    log_transition,
)

MOTION = Motion(max_speed=1.0)


class Open:
    def __init__(self, share=0.01):
        self.share = share

    def distance(self, start, ends, limit):
        straight = np.linalg.norm(ends - start, axis=1)
        return np.where(straight > limit, np.inf, straight)

    def fraction_within(self, center, radius):
        return self.share


def _frame(time, *states, how="alone"):
    """A frame with poses at (x, y, z), each with log odds."""
    return Frame(float(time), [State(Pose(np.eye(3), np.array(p, float)), o, 0.5) for p, o in states], how)


def _followed(time, *states):
    """A frame whose poses were followed from others: the scan was not searched."""
    return _frame(time, *states, how="tracked")


def _ways(frames):
    """All ways there are: of each frame a state, None where it is passed over, or UNLISTED.

    What is unlisted goes on until a state, and begins where states are left, at a frame that has some.
    """
    for way in itertools.product(*([None, UNLISTED, *range(len(f.states))] for f in frames)):
        at = UNLISTED
        for f, j in zip(frames, way, strict=True):
            if (j is None and at == UNLISTED) or (j == UNLISTED and at != UNLISTED and not f.states):
                break
            at = at if j is None else j
        else:
            yield way


class Logs:
    """What a way through frames is made of, from their states."""

    def __init__(self, frames, expected):
        self.frames, self.expected, self.emitted = frames, expected, emissions(frames)

    def steps(self, m, k):
        """(S of m, S of k)."""
        ends, seconds = state_centers(self.frames[k].states), self.frames[k].time - self.frames[m].time
        gaps = np.linalg.norm(state_centers(self.frames[m].states)[:, None] - ends, axis=2)
        return log_transition(gaps, seconds, MOTION, self.expected)

    def unlisted(self, k):
        if len(self.emitted[k]) == 0:
            return 0.0
        telling = [m for m in range(k) if self.frames[m].is_telling]
        share = float(self.frames[k].is_telling)
        share *= (
            max(fraction_moved(self.frames[telling[-1]], self.frames[k]), LEAST_TOLD)
            if telling and share
            else 1.0
        )
        gained = max([0.0, *(self.steps(m, k).max() for m in range(k) if len(self.emitted[m]))])
        return max(self.emitted[k].max() + gained - share * (TELLING_LOG + gained), 0.0)

    def of(self, way):
        log, before = 0.0, None
        for k, j in ((k, j) for k, j in enumerate(way) if j is not None):
            log += self.unlisted(k) if j == UNLISTED else self.emitted[k][j]
            if before is not None:
                m, i = before
                steps = self.steps(m, k)
                log += log_leaving(steps, self.frames[k])[i] if j == UNLISTED else steps[i, j]
            elif j != UNLISTED:
                log += log_entering(self.frames[k])
            before = None if j == UNLISTED else (k, j)
        return log


def _naive(frames, expected):
    """Probabilities of all frames' states, and the likeliest way, by going every way there is."""
    logs = Logs(frames, expected)
    ways = {way: logs.of(way) for way in _ways(frames)}
    weights = [np.zeros(len(f.states)) for f in frames]
    for way, log in ways.items():
        for k, j in enumerate(way):
            if j not in (None, UNLISTED):
                weights[k][j] += np.exp(log)
    total = sum(np.exp(list(ways.values())))
    best = max(ways, key=lambda way: ways[way])
    return [w / total for w in weights], [None if j == UNLISTED else j for j in best]


@pytest.mark.parametrize("seed", range(12))
def test_probabilities_and_way_are_those_of_all_ways_there_are(seed):
    rng = np.random.default_rng(seed)
    frames = []
    for k in range(5):
        states = [(rng.uniform(0.0, 4.0, 3), float(rng.normal(1.5, 2.0))) for _ in range(rng.integers(0, 4))]
        how = rng.choice(["alone", "tracked"])
        frames.append(_frame(k + 0.3 * rng.random(), *states, how=how))
    lattice = build_lattice(frames, Open(np.exp(-seed / 4)), MOTION)
    path, (probabilities, chosen) = lattice.smooth(), _naive(frames, seed / 4)
    for found, wanted in zip(path.probabilities, probabilities, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12)
    assert path.chosen == chosen
    if frames[-1].states:
        np.testing.assert_allclose(lattice.filter_last(), probabilities[-1], rtol=1e-9, atol=1e-12)


COPIES = [((9.0 * i, 0, 50), 4.0) for i in range(5)]  # with one more a list that does not end there


def test_what_is_only_followed_tells_nothing_of_places_that_are_not_listed():
    """A place as good as five others, and perhaps as more: only where there is one alone, all are sure."""
    followed = [_frame(0, ((0, 0, 0), 4.0), *COPIES), *(_followed(k, ((k, 0, 0), 6.0)) for k in range(1, 20))]
    unknown = build_lattice(followed, Open(), MOTION).smooth()
    assert max(p[0] for p in unknown.probabilities) < 0.6
    searched = [*followed, *(_frame(k, ((k, 0, 0), 6.0)) for k in range(20, 23))]
    told = build_lattice(searched, Open(), MOTION).smooth()
    assert told.chosen == [0] * 23
    assert min(p[0] for p in told.probabilities) > 0.9


def test_what_copies_say_of_each_other_does_not_add_up():
    """Twenty frames in twin rooms, each a little for the wrong one; then a place that there is once."""
    twins = [
        _frame(k, ((0.1 * k, 0, 0), 3.0), ((0.1 * k + 20, 0, 0), 3.0 + 0.9 * COPY_LOG_ODDS))
        for k in range(20)
    ]
    alone = build_lattice(twins, Open(), MOTION).smooth()
    np.testing.assert_allclose([p[0] / p.sum() for p in alone.probabilities], 0.5, atol=0.01)
    told = build_lattice([*twins, _frame(20, ((2.0, 0, 0), 6.0))], Open(), MOTION).smooth()
    assert told.chosen == [0] * 21
    assert min(p[0] for p in told.probabilities) > 0.95


def test_what_tells_copies_apart_counts_as_far_as_the_camera_has_moved():
    def behind(step, gap):
        frames = [_frame(k, ((step * k, 0, 0), 6.0), ((step * k + 20, 0, 0), 6.0 - gap)) for k in range(2)]
        return [odds[0] - odds[1] for odds in emissions(frames)]

    middle = (COPY_LOG_ODDS + OTHER_LOG_ODDS) / 2.0
    first, at_once = behind(0.0, middle)
    assert 0.0 < at_once < first < middle
    assert behind(1.0, middle)[1] == pytest.approx((at_once + first) / 2.0)
    assert behind(4.0, middle) == pytest.approx([first, first])
    assert behind(4.0, COPY_LOG_ODDS) == pytest.approx([0.0, 0.0])
    assert behind(0.0, OTHER_LOG_ODDS) == pytest.approx([OTHER_LOG_ODDS, OTHER_LOG_ODDS])


def test_a_jump_has_a_price_and_is_reported():
    frames = [
        *(_frame(k, ((k, 0, 0), 5.0)) for k in range(4)),
        *(_frame(k, ((k + 50, 0, 0), 5.0)) for k in range(4, 8)),
    ]
    path = build_lattice(frames, Open(), MOTION).smooth()
    assert path.chosen == [0] * 8
    assert path.gaps == [None] * 4 + [(51.0, 1.0)] + [None] * 3
    lonely = [*frames[:4], _frame(4, ((54, 0, 0), 2.0)), _frame(5, ((5, 0, 0), 5.0))]
    path = build_lattice(lonely, Open(), MOTION).smooth()
    assert path.chosen == [0, 0, 0, 0, None, 0]
    assert path.probabilities[4][0] < 0.01


def test_refusals():
    with pytest.raises(InputError, match=r"^times: found 1.0 after 2.0 at frame 2, wanted them to rise$"):
        check_times([0.0, 2.0, 1.0])
    with pytest.raises(InputError, match=r"^times: found one that is no finite number, wanted seconds$"):
        check_times([0.0, np.nan])
    with pytest.raises(InputError, match=r"^max_speed: found -1.0, wanted a number above 0$"):
        Motion(max_speed=-1.0)
