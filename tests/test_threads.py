import threading

import pytest

from piccolo.runtime.threads import Workers


@pytest.mark.parametrize("num_threads", [1, 3])
def test_results_come_in_order_and_pass_the_display(num_threads):
    seen = []

    def show(values, total, label):
        seen.append((total, label))
        return values

    squares = Workers(num_threads, show).map(lambda i: i * i, range(20), "squares")
    assert list(squares) == [i * i for i in range(20)]
    assert seen == [(20, "squares")]


def test_an_error_drops_what_has_not_begun():
    begun = []
    gate = threading.Event()

    def work(i):
        begun.append(i)
        if i == 0:
            raise ValueError("first")
        gate.wait(0.5)

    with pytest.raises(ValueError, match="first"):
        list(Workers(2).map(work, range(1000), "work"))
    assert len(begun) < 10  # what the two threads had begun
