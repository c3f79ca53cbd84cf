"""Text and JSON files in other encodings, too deep or with halves of letters are bad data that names the file."""

import pytest

from dpcli.errors import DataError
from dpcli.text_files import check_depth, parse_json, read_json, read_text


@pytest.mark.parametrize(
    "data", [b"", b"{", b"[" * 100_000, b'{"a": "\\ud800"}', b'"\xe9"', '{"a": 1}'.encode("utf-16"), b"9" * 5000, b"\0"]
)
def test_what_is_no_json_is_said_with_the_name(data, tmp_path):
    path = tmp_path / "meta.json"
    path.write_bytes(data)
    with pytest.raises(DataError, match="meta.json: (is not (JSON|text)|nested)"):
        read_json(path)


def test_two_values_of_one_key_are_refused_unless_browsers_read_the_file():
    text = '{"a": [{"fx": 1, "b": 2, "fx": 3}]}'
    with pytest.raises(DataError, match="k.json: is not JSON .two values of the key 'fx' in one mapping; keep one"):
        parse_json(text, "k.json")
    assert parse_json(text, "k.json", as_browsers=True) == {"a": [{"fx": 3, "b": 2}]}


def test_a_byte_order_mark_and_pairs_of_surrogates_are_read(tmp_path):
    path = tmp_path / "meta.json"
    path.write_bytes(b'\xef\xbb\xbf{"a": "\\ud83d\\ude00 \xc3\xa9"}')
    assert read_json(path) == {"a": "\U0001f600 é"}
    path.write_bytes("é".encode("latin-1"))
    with pytest.raises(DataError, match="byte 0 is 0xe9"):
        read_text(path)


def test_what_is_nested_deeper_than_walkers_go_is_refused():
    for depth, text in (
        (100, "[" * 100 + "]" * 100),
        (101, '{"a":' * 101 + "1" + "}" * 101),
        (500, "[" * 500 + "]" * 500),
    ):
        if depth > 100:
            with pytest.raises(DataError, match="a.json: nested more than 100 deep"):
                parse_json(text, "a.json")
        else:
            assert parse_json(text, "a.json")
    circle: list = []
    circle.append({"a": circle})
    with pytest.raises(DataError, match="nested more than 100 deep"):
        check_depth(circle, "a.yaml")
    laughs = ["ha"]
    for _ in range(12):
        laughs = [laughs] * 10
    with pytest.raises(DataError, match="in more than 1000 places"):
        check_depth(laughs, "a.yaml")
