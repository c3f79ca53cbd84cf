"""The fast ways to read plain numbers give Python's own floats to the bit, or None."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.prepare.cloud_formats import plain_numbers
from dpcli.prepare.cloud_formats.plain_numbers import parse_plain

FORMS = ("{:.3f}", "{:g}", "{:.9g}", "{:.17g}", "{:.4e}", "{:+.2f}", "{!r}", "{:.0f}", "{:.1f}0")
WAYS = (0, 1 << 40)  # bytes from which on the compiled parser reads: always, never


@settings(max_examples=150, derandomize=True, deadline=None)
@given(data=st.data())
@pytest.mark.parametrize("large", WAYS)
def test_numbers_are_python_s_own(large, data):
    width, delimiter = data.draw(st.integers(1, 5)), data.draw(st.sampled_from([None, ",", ";", "\t"]))
    form, limit = data.draw(st.sampled_from(FORMS)), data.draw(st.sampled_from([None, 2, 50]))
    finite = st.floats(-1e9, 1e9) | st.floats(allow_infinity=False, allow_nan=False) | st.integers(-99, 99)
    rows = data.draw(st.lists(st.lists(finite, min_size=width, max_size=width), min_size=1, max_size=6))
    cells = [[form.format(float(value)) for value in row] for row in rows]
    ends = data.draw(st.sampled_from(["", "\n", "\n\n"]))
    text = data.draw(st.sampled_from(["\n", "\n\n"])).join((delimiter or "  ").join(row) for row in cells) + ends
    expected = np.array([[float(cell) for cell in row] for row in cells])[:limit]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plain_numbers, "_LARGE", large)
        found = parse_plain(text, width, delimiter, limit)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(np.signbit(found), np.signbit(expected))


@pytest.mark.parametrize("large", WAYS)
@pytest.mark.parametrize(
    ("text", "delimiter"),
    [
        ("1 2 3\n4 5", None),
        ("1 2 3\n4 5 6 7", None),
        ("1 2\n3 4 5 6\n", None),
        ("1,2,3\n4,,6\n", ","),
        ("1,2,3,\n4,5,6\n", ","),
        (",1,2,3\n", ","),
        ("1 2 word", None),
        ("1 2 3a", None),
        ("1 2 3..5", None),
        ("1 2 -", None),
        ("1 2 1e", None),
        ("1 2 .", None),
        ("1 2 0x3", None),
        ("1 2 1_0", None),
        ('1 2 "3"', None),
        ("1 2 3 # a comment", None),
        ("1.5 2,5 3", None),
        ("", None),
        ("1 2 é", None),
    ],
)
def test_what_is_not_plain_is_left_to_others(large, text, delimiter, monkeypatch):
    monkeypatch.setattr(plain_numbers, "_LARGE", large)
    assert parse_plain(text, 3, delimiter) is None


@pytest.mark.parametrize("large", WAYS)
def test_not_a_number_and_limits(large, monkeypatch):
    monkeypatch.setattr(plain_numbers, "_LARGE", large)
    np.testing.assert_array_equal(parse_plain("nan 1 -2\n3 NaN 4\n", 3, None), [[np.nan, 1, -2], [3, np.nan, 4]])
    assert parse_plain("1 2 3\n3 0 1 2\n", 3, None, 1).tolist() == [[1, 2, 3]]
    assert parse_plain("1 2 3 4\n", 3, None, 1) is None
