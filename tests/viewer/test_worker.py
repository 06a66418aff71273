import threading

from tdf_jax.viewer.worker import Worker


def test_only_the_latest_request_of_a_name_is_computed():
    done, begun, go = [], threading.Event(), threading.Event()

    def first():
        begun.set()
        go.wait(10)
        done.append("first")

    with Worker(print) as worker:
        worker.ask("drag", first)
        begun.wait(10)
        for number in range(5):
            worker.ask("drag", lambda number=number: done.append(number))
        worker.ask("other", lambda: done.append("other"))
        assert not worker.wait(0.01)
        go.set()
        assert worker.wait(10)
    assert done == ["first", 4, "other"]


def test_a_failure_is_told_and_the_worker_goes_on(capsys):
    told, done = [], []

    def fails():
        raise ValueError("no pick")

    with Worker(told.append) as worker:
        worker.ask("a", fails)
        worker.ask("b", lambda: done.append(1))
        assert worker.wait(10)
    assert told == ["ValueError: no pick"] and done == [1]
    assert "ValueError: no pick" in capsys.readouterr().err
