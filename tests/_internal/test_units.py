"""Units of length agree with scipy's, and no spelling stands for two of them."""

from collections import Counter

import pytest
import scipy.constants

from tdf_jax._internal.units import UNITS

EXACT = {
    "metres": 1.0,
    "centimetres": scipy.constants.centi,
    "millimetres": scipy.constants.milli,
    "inches": scipy.constants.inch,
    "decimetres": scipy.constants.deci,
    "kilometres": scipy.constants.kilo,
    "micrometres": scipy.constants.micron,
    "feet": scipy.constants.foot,
}


def test_lengths_are_scipys():
    assert {unit.name: unit.metres for unit in UNITS} == pytest.approx(EXACT, rel=1e-12, abs=0)


def test_no_spelling_stands_for_two_units():
    counts = Counter(spelling for unit in UNITS for spelling in unit.spellings)
    assert max(counts.values()) == 1
    assert all(spelling == spelling.lower() for spelling in counts)
