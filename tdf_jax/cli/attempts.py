"""The folder of what `tdf benchmark` has computed, from which a run that was interrupted continues."""

from pathlib import Path

from tdf_jax._internal.errors import InputError

RUNS = "runs"


def attempts_folder(function: str, out: Path, page: str, record: str) -> Path:
    """Make the folder at the start of a benchmark: an error at its end would lose an hour of work.

    Args:
        function: name that error messages begin with.
        out: folder of the page.
        page: name of the page.
        record: path of the record in the same folder; its own folder is made too.

    Returns:
        The folder.

    Raises:
        InputError: the page is not of an earlier benchmark, or a folder cannot be made.
    """
    if (out / page).exists() and not (out / record).exists():
        raise InputError(
            f"{function}: {out / page} is not of an earlier benchmark, there is no {record} beside it; expected "
            "another --out: nothing of yours is overwritten"
        )
    for folder in (out / RUNS, (out / record).parent):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{function}: cannot make the folder {out} ({error}); expected a writable place") from None
    return out / RUNS
