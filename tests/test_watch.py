"""Long work that is watched."""

import re

import pytest

from jast._src.runtime.progress_bar import Watch, in_pieces


def watched(callback):
    with Watch("search", 1000, "sim", False, callback) as watch:
        watch.more(10)
        watch.reach(30, best=1)
        watch.tell(lambda: "so far")


def test_the_callback_takes_three():
    seen = []
    watched(lambda *three: seen.append(three))
    assert seen == [(10, 1000, None), (30, 1000, "so far")]


def test_defaults_and_methods_are_callbacks():
    seen = []

    class Log:
        def add(self, done, total, result=None):
            seen.append(done)

    watched(Log().add)
    watched(print_nothing := (lambda done, total, result, more=1: seen.append(more)))
    assert seen == [10, 30, 1, 1] and callable(print_nothing)


@pytest.mark.parametrize("bad", [3, "x"])
def test_what_cannot_be_called_is_refused(bad):
    with pytest.raises(ValueError, match="search: callback must be callable, .*received"):
        Watch("search", 10, "sim", False, bad)


def test_the_bar_says_how_far(capsys):
    with Watch("search", 20, "sim", True, None, done=5) as watch:
        watch.reach(12, failures=3)
        watch.more(8)
    text = capsys.readouterr().err
    assert "search: " in text
    assert "20/20" in text
    assert "failures=3" in text


def test_the_bar_says_what_the_work_is_at(capsys):
    with Watch("search", 20, "sim", True, None) as watch:
        watch.reach(12)
        watch.doing("refining")
        watch.reach(20)
    said = re.findall(r"search[^|]*?(?=:  *[0-9])", capsys.readouterr().err)
    assert [text for i, text in enumerate(said) if text not in said[:i]] == [
        "search: compiling",
        "search: refining",
    ]
    with Watch("search", 20, "sim", True, None) as watch:
        watch.reach(20)
    lines = re.split(r"[\r\n]+", capsys.readouterr().err.strip())
    assert lines[0].startswith("search: compiling: ") and lines[-1].startswith("search: 100%")
    with Watch("search", 20, "sim", False, None) as watch:
        watch.doing("nothing, without a bar")


def test_the_result_so_far_is_made_for_a_callback_only():
    watch = Watch("search", 10, "sim", False, None)
    watch.tell(lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        Watch("search", 10, "sim", False, print).tell(lambda: 1 / 0)


def interrupted(at, callback=None):
    """Sums 1 .. 5 in pieces that end at 2, 4, 5; the one that begins at ``at`` is interrupted."""

    def work(total, begin, end):
        if begin == at:
            raise KeyboardInterrupt
        return total + sum(range(begin + 1, end + 1))

    watch = Watch("sum", 50, "number", False, callback)
    return in_pieces(work, 0, [2, 4, 5], watch, units=lambda end: 10 * end)


def test_pieces_are_done_in_order_and_told():
    seen = []
    assert interrupted(None, lambda *three: seen.append(three)) == (15, 5)
    assert seen == [(20, 50, None), (40, 50, None), (50, 50, None)]


def test_an_interruption_leaves_whole_pieces():
    assert interrupted(4) == (10, 4) and interrupted(2) == (3, 2)
    with pytest.raises(KeyboardInterrupt):
        interrupted(0)


def test_an_interruption_by_the_callback_comes_after_its_piece():
    def stop(done, total, result):
        raise KeyboardInterrupt

    assert interrupted(None, stop) == (3, 2)
