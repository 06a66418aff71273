"""Columns of numbers, in text and in arrays: which of them are x, y and z."""

import csv
import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from tdf_jax._internal.units import UNITS
from tdf_jax.io.content import UnsupportedError
from tdf_jax.io.text import MIXED_SIGNS, decode, numbers

_COMMENTS = ("#", "//", "%", "!")
MOST_COLUMNS = 20  # with a normal, a colour, an intensity and some features; a depth image has hundreds
# x, "X", x [mm], x_mm, Points:0 and the like. What stands after the axis is a unit.
_NAME = re.compile(
    r"(?:points?[_:. ]*|pos(?:ition)?[_:. ]*|coord[_:. ]*)?([xyz012])[\s_]*(?:[\[(/]?\s*([a-z]+)\s*[\])]?)?"
)
_METRES = {spelling: unit.metres for unit in UNITS for spelling in unit.spellings}
_NAME_THEM = "or write the names of all columns into the first line of a text, such as x y z r g b"
_MISSING = {"", "null", "none", "na", "n/a", "-", "--"}
# Six fields without a decimal point are enough for three numbers with decimal commas: 0,12,0,34,0,56.
_WHOLE = r"\s*[+-]?\d+([eE][+-]?\d+)?\s*"
_WHOLE_FIELDS = re.compile(f"{_WHOLE}(,{_WHOLE}){{5}}(,|$)")


def read_columns(data: bytes, scale: float = 1.0) -> Float[np.ndarray, "points 3"]:
    """Read the points of a text file with one point in each line.

    The numbers are separated by blanks, tabs, commas or semicolons; their decimal sign is a point, or a comma where
    that is clear. Lines that begin with # or // are comments. A first line may name the columns, or give the number of
    points. Without names the columns are taken as `coordinate_columns` does.

    Args:
        data: content of the file.
        scale: metres per unit of the file, to be compared with a unit that the header names.

    Returns:
        Point cloud, (points, 3), in the unit and frame of the file. An empty field is NaN.

    Raises:
        ValueError: the file is damaged.
        UnsupportedError: it is not clear which columns are x, y and z, or how the numbers are written.
    """
    rows, names = _lines(decode(data))
    rows = _without_count(rows)
    if not rows:
        raise ValueError("it has no numbers")
    delimiter, comma = _dialect([row for _, row in rows[1:21] or rows])
    header = _header(rows, delimiter, comma)
    if header is not None:
        rows, names = rows[1:], [header]
        if not rows:
            raise ValueError("it has a line of names, and no numbers")
    values = None if comma else _plain(rows, delimiter)
    if values is None:
        table = _table(rows, delimiter, comma)
        width, row_names = len(table[0]), _are_row_names([row[0] for row in table])
        _refuse_molecule(table, rows)
    else:
        table = []
        width, row_names = values.shape[1], _count_rows(values[:, 0])
    columns = _named(names, width, row_names and delimiter is None, scale, required=header is not None)
    if columns is not None:
        return _values(table, columns, rows) if values is None else values[:, columns]
    if width < 3:
        raise UnsupportedError(f"has {width} columns; expected x, y and z in each line")
    if delimiter == "," and width >= 6 and all(_WHOLE_FIELDS.match(row) for _, row in rows):
        raise UnsupportedError(
            f"has {width} columns between commas, which may be whole numbers or decimal commas; expected decimal "
            "points; if they are whole numbers, write the names of all columns into the first line, such as x,y,z,r,g,b"
        )
    if values is None:
        values = np.full((len(table), width), np.nan)
        for column in range(width if width <= MOST_COLUMNS else 0):
            try:
                values[:, column] = _values(table, [column], rows)[:, 0]
            except ValueError:  # after the coordinates there may be words
                if column < 3:
                    raise
    return coordinate_columns(values)


def coordinate_columns(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows 3"]:
    """Take the coordinates from columns without names: the first three, or those after a column that counts the rows.

    Args:
        values: numbers, (rows, columns). Colours, normals and the like after the coordinates are left out, and so is
            a first column that has every number from 0 or 1 on once, in any order.

    Returns:
        The coordinates, (rows, 3).

    Raises:
        UnsupportedError: there are fewer than three columns or more than 20, the first may be a number of the point, a
            time, a label or a pixel, the first three may be a colour or a normal, or the rows are poses.
    """
    width = values.shape[1]
    if width < 3:
        raise UnsupportedError(f"has {width} columns; expected x, y and z in each row")
    if width > MOST_COLUMNS:
        raise UnsupportedError(
            f"has {width} columns; expected at most {MOST_COLUMNS}, x y z first; keep the first three"
        )
    if width == 3:
        if _count_rows(values[:, 0]):
            raise UnsupportedError("has a first column that counts the rows, and two more; expected x, y and z")
        return values
    if _number_rows(values[:, 0]):
        # A scan line in whole millimetres may run down to 0 or 1 as well; numbers in disorder are no coordinates.
        if (np.diff(values[:, 0]) == -1).all() and all(map(_are_whole, values.T[1:4])):
            _refuse_first("falling numbers")
        return values[:, 1:] if width == 4 else coordinate_columns(values[:, 1:])
    if _are_poses(values):
        raise UnsupportedError("has rows that are poses, or quaternions of norm 1; expected points x y z")
    _check_first(values[np.isfinite(values[:, :3]).all(axis=1)])
    return values[:, :3]


def _check_first(values):
    """Refuse columns whose first ones may be something else than x, y and z."""
    if len(values) < 2:
        return
    whole = [_are_whole(column) for column in values.T[:4]]
    different = [len(np.unique(column)) for column in values.T[:4]]
    if whole[0] and not (whole[1] and whole[2]):
        _refuse_first("whole numbers")
    normals = values.shape[1] >= 6 and _are_unit(values[:, 3:6])
    if values.shape[1] >= 6:
        if _are_colours(values[:, :3]) and not _are_colours(values[:, 3:6]) and not normals:
            _refuse_three("whole numbers from 0 to 255", "colours")
        if _are_unit(values[:, :3]) and not normals:
            _refuse_three("norm 1", "normals")
    steps = np.diff(values[:, 0])
    if ((steps >= 0).all() or (steps <= 0).all()) and not (normals or _is_fourth_behind(values, whole)):
        _refuse_first(f"{'few different' if not steps.any() else 'rising' if steps.max() > 0 else 'falling'} numbers")
    if whole[0] and 4 * different[0] <= sorted(different[1:])[1]:
        _refuse_first("few different numbers")
    # Coordinates in whole millimetres repeat; numbers of points do not.
    if whole[0] and different[0] == len(values) and 4 * max(different[1:]) <= 3 * len(values):
        _refuse_first("different whole numbers")


def _refuse_first(kind):
    raise UnsupportedError(
        f"has a first column of {kind}, unlike those after it, which may be numbers of the points, times or labels; "
        f"expected x y z first; remove the first column, or all columns after x y z, {_NAME_THEM}"
    )


def _refuse_three(kind, what):
    raise UnsupportedError(
        f"has first three columns of {kind}, unlike those after them, which may be {what}; expected x y z first; "
        f"remove what is not x y z, {_NAME_THEM}"
    )


def _are_whole(column):
    return bool(np.isfinite(column).all() and (column == np.rint(column)).all())


def _are_colours(columns):
    return all(map(_are_whole, columns.T)) and bool((columns >= 0).all() and (columns <= 255).all())


def _are_unit(columns):
    return len(columns) > 0 and bool((np.abs(np.linalg.norm(columns, axis=1) - 1) < 1e-3).all())


def _is_fourth_behind(values, whole):
    """Whether the fourth column cannot be z: it is whole, as colours and intensities are, and those before are not."""
    if whole[1] or whole[2] or not whole[3]:
        return False
    colours = values.shape[1] >= 6 and _are_colours(values[:, 3:6]) and values[:, 3:6].any()
    return bool(colours or (values[:, 3] != values[0, 3]).any())  # a scanner in one plane has one z


def named_columns(names: Sequence[str]) -> tuple[list[int], str | None] | None:
    """Find the columns that are named x, y and z.

    Args:
        names: names of the columns, such as x, "X", x [mm], x_mm or Points:0.

    Returns:
        indices of x, y and z, and their unit if the names tell it; None if one of them is missing or not unique.
    """
    found, units = {}, set()
    for column, name in enumerate(names):
        match = _NAME.fullmatch(name.strip().strip("\"'").strip().lower())
        if not match or (match[2] and match[2] not in _METRES) or (match[1].isdigit() and len(name.strip("\"' ")) < 3):
            continue
        axis = "xyz"[int(match[1])] if match[1].isdigit() else match[1]
        if axis in found:
            return None
        found[axis] = column
        units.add(match[2])
    if len(found) < 3 or len(units) > 1:
        return None
    return [found[axis] for axis in "xyz"], units.pop()


def check_unit(unit: str | None, scale: float) -> None:
    """Check that the unit that names of columns tell, if they do, is the one that the caller gives.

    Args:
        unit: unit of `named_columns`, None for none.
        scale: metres per unit of the file.

    Raises:
        UnsupportedError: the two differ.
    """
    if unit is None or np.isclose(scale, _METRES[unit], rtol=1e-6, atol=0.0):
        return
    given = "" if scale == 1 else f", and scale is {scale:g}"
    fix = "leave out scale" if _METRES[unit] == 1 else f"pass scale={_METRES[unit]:g}"
    raise UnsupportedError(f"has coordinates in {unit}, as its names say{given}; {fix}, or correct the names")


def _lines(text):
    """Numbered lines with data, and what may be the names of their columns, if a comment above them gives some."""
    rows, names = [], []
    for number, line in enumerate(text.split("\n"), 1):
        line = line.strip()
        if line.startswith(_COMMENTS):
            if not rows:
                names += [re.split(delimiter, line.lstrip("#/%! \t")) for delimiter in (";", ",", "\t", r"[,;\s]+")]
            continue
        line = line.partition("#")[0].strip()
        if line and not (not rows and line.lower().startswith("sep=")):  # that line is for spreadsheets
            rows.append((number, line))
    return rows, names


def _without_count(rows):
    """Lines without a first one that gives their number, and a title after that."""
    if len(rows) < 2 or not re.fullmatch(r"\d+(\s+\d+)?", rows[0][1]):
        return rows
    count, *width = (int(word) for word in rows[0][1].split())
    _refuse_molecule([row.split() for _, row in rows[2:]], rows[2:])
    words = re.split(r"[,;\s]+", rows[1][1])
    if width:  # rows and columns
        return rows[1:] if count == len(rows) - 1 and width[0] == len(words) else rows
    if re.fullmatch(r"\d+", rows[1][1]):
        raise UnsupportedError("has single whole numbers in its first lines, as PTX has; expected x y z in each line")
    title = not _is_number(words[0])
    if title and len(rows) - 2 == count:  # a title; names of columns are looked at as those without a count
        return rows[1:] if named_columns(words) else rows[2:]
    if len(rows) - 1 != count:
        raise UnsupportedError(
            f"has the count {count} in its first line, and {len(rows) - 1 - title} points follow; expected the same; "
            "get the rest of the file if points are missing, or correct or remove the first line"
        )
    return rows[1:]


def _dialect(rows):
    """The delimiter, None for white space, and whether commas are decimal."""
    rows = [row.replace('"', "") for row in rows]
    text = "\n".join(rows)
    if ";" in text:
        return ";", "," in text
    if "\t" in text and all("\t" in row and not any(" " in cell.strip() for cell in row.split("\t")) for row in rows):
        return "\t", "," in text
    if "," not in text:
        return None, False
    words = [row.split() for row in rows]
    decimal = re.compile(r",?[+-]?\d+(,\d+)?([eE][+-]?\d+)?,?")
    inner = any(re.search(r"\d,\d", word) for row in words for word in row)
    if inner and all(len(row) >= 3 for row in words):
        if all(decimal.fullmatch(word) for row in words for word in row if "," in word or "." in word):
            return None, True
        if all(re.fullmatch(r"[-+\d.,eE]+", word) for row in words for word in row):
            raise UnsupportedError(MIXED_SIGNS)
    return ",", False


def _plain(rows, delimiter):
    """All numbers, (rows, columns), of text that has nothing but them; None for other text."""
    try:
        return np.loadtxt([row for _, row in rows], delimiter=delimiter, comments=None, ndmin=2)
    except ValueError:
        return None


def _table(rows, delimiter, comma):
    """Fields of the lines, the same number in each."""
    table = [_split(row, delimiter, comma) for _, row in rows]
    if all(row[-1] == "" for row in table) and len(table[0]) > 1:
        table = [row[:-1] for row in table]  # a delimiter at the end of each line
    width = len(table[0])
    for (number, _), row in zip(rows, table):
        if row is table[-1] and len(row) < width:
            raise ValueError(f"it ends within line {number}, which has {len(row)} columns and not {width}")
        if len(row) != width:
            raise UnsupportedError(
                f"has {len(row)} columns in line {number}, and {width} in line {rows[0][0]}; expected one point x y z, "
                "and the same numbers after it, in each line"
            )
    if comma and any(re.fullmatch(r"[+-]?\d*\.\d+", cell) for row in table for cell in row):
        raise UnsupportedError(MIXED_SIGNS)
    return table


def _split(row, delimiter, comma):
    if delimiter is None:
        cells = [cell.strip(",") for cell in row.split()] if comma else row.split()
    elif '"' in row:  # where a delimiter is no delimiter
        cells = [cell.strip() for cell in next(csv.reader([row], delimiter=delimiter, skipinitialspace=True))]
    else:
        cells = [cell.strip() for cell in row.split(delimiter)]
    return [cell.strip("\"'") for cell in cells] if '"' in row or "'" in row else cells


def _is_number(cell):
    try:
        numbers([cell])
    except ValueError:
        return False
    return True


def _header(rows, delimiter, comma):
    """Names in the first line, None if it has numbers only."""
    cells = _split(rows[0][1], delimiter, comma)
    if all(_is_number(cell) or cell.lower() in _MISSING for cell in cells):
        return None
    for names in (cells, re.split(r"[,;\t]\s*|\s+", rows[0][1])):
        if named_columns(names):
            return names
    if sum(map(_is_number, cells)) >= 3:
        return None  # a point with a word after it
    raise UnsupportedError(
        f"has the first line {rows[0][1][:80]!r}; expected numbers, or names of columns among which are x, y and z"
    )


def _named(candidates, width, row_names, scale, required):
    """Indices of the columns that are named x, y and z, None if there are no names."""
    found = [(len(names), named) for names in candidates if (named := named_columns(names))]
    fitting = [named for count, named in found if count == width]
    if fitting:
        columns, unit = fitting[-1]
    elif required and found[0][0] == width - 1 and row_names:
        columns, unit = found[0][1]  # the column of row names has none, as in R
        columns = [column + 1 for column in columns]
    elif required:
        raise UnsupportedError(
            f"names {found[0][0]} columns in its first line, and has {width}; expected one name each"
        )
    else:
        return None
    check_unit(unit, scale)
    return columns


def _are_row_names(cells):
    if not all(_is_number(cell) for cell in cells):
        return True
    return bool(_count_rows(numbers(cells)))


def _count_rows(values):
    """Whether values are the numbers of the rows, from 0 or from 1."""
    return len(values) > 1 and values[0] in {0, 1} and (np.diff(values) == 1).all()


def _number_rows(values):
    """Whether values are the numbers of the rows, from 0 or from 1, in any order."""
    rows = len(values)
    if rows < 2 or not _are_whole(values):
        return False
    return bool((np.diff(np.sort(values)) == 1).all()) and values.min() in {0, 1}


def _values(table, columns, rows):
    """Numbers of some columns, (rows, columns); NaN where a field is empty."""
    cells = [row[column] for row in table for column in columns]
    try:
        return numbers(cells).reshape(-1, len(columns))
    except UnsupportedError:
        raise
    except ValueError:
        cells = ["nan" if cell.lower() in _MISSING else cell for cell in cells]
        wrong = next((i for i, cell in enumerate(cells) if not _is_number(cell)), None)
        if wrong is not None:
            line = rows[wrong // len(columns)][0]
            raise UnsupportedError(f"has {cells[wrong][:80]!r} in line {line}; expected a number") from None
        return numbers(cells).reshape(-1, len(columns))


def _refuse_molecule(table, rows):
    if table and all(re.fullmatch(r"[A-Z][a-z]?\d*", row[0]) and len(row) > 3 for row in table):
        raise UnsupportedError(
            f"has the word {table[0][0]} in line {rows[0][0]}, as files of molecules have, which are also named .xyz; "
            "expected x y z in each line"
        )


def _are_poses(values):
    values = values[np.isfinite(values).all(axis=1)]

    def unit(columns):
        return len(values) > 0 and bool((np.abs(np.linalg.norm(values[:, columns], axis=1) - 1) < 1e-3).all())

    match values.shape[1]:
        case 4:
            return unit(slice(0, 4))
        case 7:  # wxyz_xyz, or the quaternion last; normals and a curvature may also be of norm 1
            return unit(slice(0, 4)) or (unit(slice(3, 7)) and not unit(slice(3, 6)))
        case 8:  # the TUM format, with the time first
            return unit(slice(4, 8)) and bool((np.diff(values[:, 0]) > 0).all())
    return False
