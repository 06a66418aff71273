"""The benchmark's tasks, one after the other, by every method; what was computed is kept, so that an interrupted run goes on."""

from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path

import jax
from tqdm import tqdm

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import kept
from tdf_jax.evaluation.methods import METHODS, Attempt, Attempts, tried
from tdf_jax.evaluation.path_tasks import Task
from tdf_jax.networks.model import Model, fingerprint

FORMAT = 1  # of what is kept: raised when an attempt is computed otherwise


def run(
    makers: Sequence[Callable[[], Task]],
    model: Model,
    methods: Sequence[str],
    folder: Path,
    *,
    seed: int = 0,
    inits: int = 10,
    progress: bool = True,
) -> Iterator[tuple[Task, str, Attempt]]:
    """Attempts of methods on tasks.

    Args:
        makers: each makes a task.
        model: the network.
        methods: of `METHODS`.
        folder: keeps the attempts; it exists.
        seed: of the starts.
        inits: random starts.
        progress: show a progress bar.

    Yields:
        Task, name of the method, attempt; without those that cannot be tried, and variants on every fifth task alone.

    Raises:
        InputError: there is no such method, or a kept file is damaged.
    """
    for method in methods:
        if method not in METHODS:
            raise InputError(f"run(): methods has {method!r}; expected some of {', '.join(METHODS)}")
    about = [FORMAT, version("tdf_jax"), jax.default_backend(), fingerprint(model), seed, inits]
    key = jax.random.key(seed)
    for make in tqdm(makers, desc="benchmark", unit="task", disable=not progress):
        task = make()
        attempts = Attempts(task, model, key, inits)
        for method in (method for method in methods if tried(method, task.index)):

            def arrays(method=method):
                attempt = attempts.of(method)
                return {} if attempt is None else vars(attempt)

            what = [*about, *task.identity, method]
            attempt = kept("tdf benchmark", folder, what, arrays, _attempt)
            if attempt is not None:
                yield task, method, attempt


def _attempt(arrays) -> Attempt | None:
    """Of its arrays; there are none of one that cannot be tried."""
    if not arrays:
        return None
    return Attempt(arrays["trajectories"], arrays["scores"], float(arrays["seconds"]), float(arrays["residual"]))
