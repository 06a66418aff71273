"""Text of files: bytes of any encoding, lines, and numbers. Numbers are ASCII, so that comments may be anything."""

import codecs
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from tdf_jax.io.content import UnsupportedError

# The mark of UTF-32 begins with that of UTF-16, so it comes first.
_BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF32_LE: "utf-32-le",
    codecs.BOM_UTF32_BE: "utf-32-be",
    codecs.BOM_UTF16_LE: "utf-16-le",
    codecs.BOM_UTF16_BE: "utf-16-be",
}
MIXED_SIGNS = "has numbers with commas as well as points; expected decimal points only; remove the commas"


def decode(data: bytes) -> str:
    """Decode text whose numbers and keywords are ASCII; what else there is need not come out right.

    Args:
        data: bytes of UTF-8, UTF-16 or UTF-32 with or without a byte order mark, or of any 8-bit encoding.

    Returns:
        The text, its lines ended by a line feed only.
    """
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS.items() if data.startswith(mark)), None)
    if encoding is None:
        head = data[:4096]
        zeros = [head[offset::2].count(0) for offset in (0, 1)]
        if zeros[1] > 0.4 * len(head) / 2 and not zeros[0]:
            encoding = "utf-16-le"
        elif zeros[0] > 0.4 * len(head) / 2 and not zeros[1]:
            encoding = "utf-16-be"
    if encoding is None:
        try:
            text = data.decode("utf-8")
        except UnicodeDecodeError:  # Latin-1 knows every byte: GBK and Shift-JIS come out as noise, numbers do not
            text = data.decode("latin-1")
    else:
        text = data.decode(encoding, "replace")
    # The mark may also stand where files have been joined.
    return text.replace("\ufeff", "").replace("\r\n", "\n").replace("\r", "\n")


def lines(text: str, comment: str | None = "#") -> list[str]:
    """Split text into lines without comments and white space at their ends; empty lines are left out.

    Args:
        text: text of `decode`.
        comment: what a comment begins with; None if there are no comments.

    Returns:
        The lines. `str.splitlines` would also split at bytes of comments in an 8-bit encoding.
    """
    split = (line.partition(comment)[0] if comment else line for line in text.split("\n"))
    return [line for line in map(str.strip, split) if line]


def numbers(tokens: Sequence[str]) -> Float[np.ndarray, " tokens"]:
    """Convert words to numbers.

    Args:
        tokens: words without white space. Besides decimal points, decimal commas (0,5) are read if no word has a point,
            exponents of Fortran (1.5D-3), and 1.#QNAN and 1.#INF of Windows, as NaN and infinity.

    Returns:
        The numbers, float64.

    Raises:
        ValueError: a word is no number.
        UnsupportedError: decimal commas and points are mixed.
    """
    try:
        return np.array(tokens, dtype=np.float64)
    except ValueError:
        if any("," in token for token in tokens):
            if any("." in token for token in tokens) or any(token.count(",") > 1 for token in tokens):
                raise UnsupportedError(MIXED_SIGNS) from None
            tokens = [token.replace(",", ".") for token in tokens]
        return np.array([_number(token) for token in tokens])


def indices(tokens: Sequence[str]) -> Int[np.ndarray, " tokens"]:
    """Convert words to whole numbers.

    Args:
        tokens: words without white space.

    Returns:
        The numbers, int64.

    Raises:
        ValueError: a word is no whole number.
    """
    try:
        return np.array(tokens, dtype=np.int64)
    except (ValueError, OverflowError):
        values = np.array([_number(token) for token in tokens])
        whole = np.isfinite(values) & (np.abs(values) < 2**53)
        whole[whole] = values[whole] == np.rint(values[whole])
        if not whole.all():
            raise ValueError(f"{tokens[int(np.argmin(whole))]!r} is no whole number") from None
        return values.astype(np.int64)


def _number(token: str) -> float:
    try:
        return float(token)
    except ValueError:
        word = token.upper().lstrip("+-")
        if word.startswith(("1.#INF", "1.#QNAN", "1.#SNAN", "1.#IND", "NAN(", "1.#R")):
            return float("inf") if word.startswith("1.#INF") else float("nan")
        try:
            return float(word.replace("D", "E")) * (-1.0 if token.startswith("-") else 1.0)
        except ValueError:
            raise ValueError(f"{token!r} is no number") from None
