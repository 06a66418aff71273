"""What a case is, and the verdict about it."""

import contextlib
import dataclasses
import hashlib
import os
import re
import signal
import stat
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

RIGHT, WARNED, REFUSED, BAD = "right", "warned", "refused", "bad"
VERDICTS = (RIGHT, WARNED, REFUSED, BAD)
ANY = frozenset({RIGHT, WARNED, REFUSED})
DOUBT = frozenset({WARNED, REFUSED})  # a right result is not possible
ONLY_RIGHT, ONLY_REFUSED = frozenset({RIGHT}), frozenset({REFUSED})
SECONDS = 60  # a case that takes longer on an idle machine hangs
LONGEST = 3000  # characters of a message


@dataclasses.dataclass(frozen=True)
class Case:
    """One call with one hostile input.

    Attributes:
        kind: kind of input.
        text: what is hostile about it.
        act: the call.
        check: says what is wrong with the result; None if nothing is.
        expected: verdicts that are not bad.
        writes: names of files that a call that succeeds may write into the case's folder.
    """

    kind: str
    text: str
    act: Callable[[], Any]
    check: Callable[[Any], str | None] = lambda result: None
    expected: frozenset[str] = ANY
    writes: tuple[str, ...] = ()


class Hang(BaseException):
    """Raised in a call that takes too long."""


def patience() -> float:
    """Seconds after which a case hangs, on a machine that is as busy as this one."""
    return SECONDS * min(3.0, max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1)))


def judge(case: Case, folder: Path) -> tuple[str, str]:
    """Run a case.

    Args:
        case: the case.
        folder: folder of its files.

    Returns:
        The verdict, and what happened: the message, or the traceback.
    """
    before = snapshot(folder)
    with warnings.catch_warnings(record=True) as caught, time_limit(patience()):
        warnings.simplefilter("always")
        try:
            verdict, happened = _judged(case, caught)
        except Hang:
            verdict, happened = BAD, f"takes more than {patience():.0f} s\n{traceback.format_exc()}"
    after = snapshot(folder)
    written = {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}
    allowed = set() if verdict == REFUSED else set(case.writes)
    if verdict != BAD and written - allowed:
        verdict, happened = BAD, f"{verdict}, and writes {sorted(written - allowed)}: {happened}"
    if verdict != BAD and verdict not in case.expected:
        verdict, happened = BAD, f"{verdict}; expected {' or '.join(sorted(case.expected))}: {happened}"
    return verdict, happened


def _judged(case, caught):
    from tdf_jax import InputError, TdfWarning

    try:
        result = case.act()
        problem = case.check(result)
    except InputError as error:
        problem = message_problem(str(error))
        return (REFUSED, str(error)) if problem is None else (BAD, f"the message {problem}: {error}")
    except Hang:
        raise
    except BaseException:
        return BAD, traceback.format_exc()
    if problem is not None:
        ours = [str(one.message) for one in caught if issubclass(one.category, TdfWarning)]
        return (WARNED, ours[0]) if ours else (BAD, f"wrong in silence: {problem}")
    for one in caught:
        if not issubclass(one.category, TdfWarning | DeprecationWarning):
            return BAD, f"warns of {one.category.__name__}: {one.message} ({one.filename}:{one.lineno})"
    ours = [str(one.message) for one in caught if issubclass(one.category, TdfWarning)]
    return (WARNED, ours[0]) if ours else (RIGHT, "")


FUNCTION = re.compile(r"(tdf( [a-z]+)?|[A-Za-z_.]+\(\))[: ]")
WORDS = (
    "expected use save check give drop remove multiply subtract copy choose delete invert add re-save run rename train "
    "must download convert compute correct lower raise move reduce keep repair divide free write put transpose restore"
)
FIX = re.compile(rf"\b({'|'.join(WORDS.split())})\b", re.IGNORECASE)


def message_problem(text: str) -> str | None:
    """Say what a message for a user lacks; None if nothing."""
    if not FUNCTION.match(text):
        return "does not begin with the function"
    if not FIX.search(text):
        return "says neither what is expected nor a fix"
    if len(text) > LONGEST:
        return f"has {len(text)} characters"
    return "shows a traceback" if "Traceback (" in text else None


def snapshot(folder: Path) -> dict[str, str]:
    """What lies in a folder, links not followed: a digest for each name."""
    found = {}
    for root, folders, names in os.walk(folder):
        for name in folders + names:
            path = os.path.join(root, name)
            status = os.lstat(path)
            content = b""
            if stat.S_ISLNK(status.st_mode):
                content = os.fsencode(os.readlink(path))
            elif stat.S_ISREG(status.st_mode):
                content = Path(path).read_bytes()
            found[os.path.relpath(path, folder)] = f"{stat.S_IFMT(status.st_mode)} {hashlib.sha1(content).hexdigest()}"
    return found


@contextlib.contextmanager
def time_limit(seconds: float):
    """Raise `Hang` in the block after some seconds; a call that never comes back to Python needs a watching process."""

    def stop(number, frame):
        raise Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


# What is wrong with a result


def differs(found, expected, tolerance: float = 1e-6) -> str | None:
    """Say how an array differs from the expected one; None if it does not."""
    found, expected = np.asarray(found, float), np.asarray(expected, float)
    if found.shape != expected.shape:
        return f"shape {found.shape}; expected {expected.shape}"
    largest = np.abs(found - expected).max(initial=0.0)
    return None if largest <= tolerance * max(1.0, np.abs(expected).max(initial=0.0)) else f"differs by {largest:.3g}"


def differs_as_set(found, expected, tolerance: float = 1e-6) -> str | None:
    """Say how rows differ, whatever their order; None if they do not."""
    found, expected = np.asarray(found, float), np.asarray(expected, float)
    if found.shape != expected.shape:
        return f"shape {found.shape}; expected {expected.shape}"
    order = [np.lexsort(np.round(rows, 5).T) for rows in (found, expected)]
    return differs(found[order[0]], expected[order[1]], tolerance)
