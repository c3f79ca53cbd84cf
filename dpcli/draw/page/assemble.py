"""A page put together from its template, styles, scripts and data, and written whole."""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from dpcli.runtime.whole_file import write_whole
from dpcli.standard_streams import printable

_MARK = re.compile(r"<!--([A-Z]+)-->")
# shared/ is in every page, the scene viewer's too; web/ is of the pages about a file, which have one template and one style sheet.
STYLE, SHARED = "shared/theme.css", ("shared/base.js", "shared/player.js", "shared/stage.js", "shared/gl.js")
_TEMPLATE, _DATA_STYLE = "web/page.html", "web/data.css"


def source_text(name: str, package: str = __package__) -> str:
    """Returns a template, style sheet or script that lies beside the code of `package`."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def script_text(names: Sequence[str], package: str = __package__) -> str:
    """Returns several scripts of `package` as one text, in the order of their names."""
    return "\n".join(source_text(name, package) for name in names)


def filled(template: str, marks: Mapping[str, str]) -> str:
    """Replaces every `<!--MARK-->` of the template. Contents are not searched again, so no content can bring a mark in."""
    return _MARK.sub(lambda found: marks[found[1]], template)


def as_json(header: Any) -> str:
    """Returns a value as JSON that may stand within a `<script>`: it holds no `<`, so nothing in it can end the script."""
    return json.dumps(_spelled(header), allow_nan=False, sort_keys=True).replace("<", "\\u003c")


def _spelled(value: Any) -> Any:
    """Returns a value of JSON whose texts, names among them, are printable; a page shows them as they are."""
    if isinstance(value, str):
        return printable(value, kept="\n\t")
    if isinstance(value, Mapping):
        return {_spelled(key): _spelled(one) for key, one in value.items()}
    return [_spelled(one) for one in value] if isinstance(value, (list, tuple)) else value


def as_base64(data: bytes) -> str:
    """Returns bytes, compressed (deflate), as base64; `unpacked` of base.js reverses it. Equal bytes give equal text."""
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii")


def data_blocks(blocks: Sequence[bytes]) -> str:
    """Returns binary data as elements with the ids data0, data1, ...; a script unpacks one when it needs it."""
    return "\n".join(
        f'<script type="text/plain" id="data{at}">{as_base64(block)}</script>' for at, block in enumerate(blocks)
    )


def data_page(header: Mapping[str, Any], name: str, *, script: Sequence[str], data: str = "") -> str:
    """Returns a page about one file.

    header: values for the script, among them `title`. name: of the page: NAME.html is its middle, and the style sheet knows it.
    script: names of the page's own scripts, in their order. data: HTML of the elements that hold further data.
    """
    return filled(
        source_text(_TEMPLATE),
        {
            "TITLE": html.escape(printable(str(header["title"]))),
            "STYLE": source_text(STYLE) + source_text(_DATA_STYLE),
            "BODY": name,
            "MAIN": source_text(f"web/{name}.html"),
            "HEADER": as_json(header),
            "DATA": data,
            "SCRIPT": script_text([*SHARED, *(f"web/{one}.js" for one in script)]),
        },
    )


def write_page(page: str, path: Path) -> int:
    """Writes a page whole or not at all and returns its size in bytes. Raises DataError when it can't be written."""
    content = page.encode("utf-8", "replace")
    write_whole(path, content)
    return len(content)
