"""Work that is done in parts."""

from collections.abc import Generator

from maplab_py.frontend.initialization.paced_work import PacedWork, Work, each_step, finished


def counting(done: list[int], parts: list[float]) -> Work[str]:
    for number, units in enumerate(parts):
        done.append(number)
        yield units
    return "result"


def test_no_more_is_done_than_allowed_but_for_the_last_part() -> None:
    done: list[int] = []
    work = PacedWork(counting(done, [4.0, 4.0, 20.0, 4.0, 4.0]))
    lengths = []
    result = None
    while result is None:
        result = work.advance(10.0)
        lengths.append(len(done))
    # the third part takes twice a share: the next call makes up for it
    assert lengths == [3, 3, 4, 5]
    assert result == "result"


def test_steps_are_counted() -> None:
    def steps() -> Generator[None, None, int]:
        yield
        yield
        return 7

    def work() -> Work[int]:
        result = yield from each_step(steps(), 3.0)
        return 10 * result

    parts = work()
    assert [next(parts), next(parts)] == [3.0, 3.0]
    assert finished(work()) == 70
