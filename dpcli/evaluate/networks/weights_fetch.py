"""Downloads the weights of learned metrics, when the user asks for them and never otherwise."""

from __future__ import annotations

import http.client
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from dpcli.errors import DataError, DpcError
from dpcli.evaluate.networks.weights import Checked, Weights, check_file
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.whole_file import make_folder, whole_file

_BLOCK = 1 << 18  # bytes
_TIMEOUT = 30.0  # seconds without a byte
_AGENT = {"User-Agent": "dpc"}  # some hosts refuse urllib's own


def fetch_weights(weights: Weights, folder: Path) -> list[Path]:
    """Downloads an entry's files into `folder`, each beside its place, checked, then renamed; whole ones are kept.

    Raises DpcError when a file can't be had (no network, refused); DataError when what came isn't the published file.
    """
    for each in weights.files:
        _fetch_file(each, folder / each.file)
    return [folder / each.file for each in weights.files]


def _fetch_file(weights: Weights, path: Path) -> None:
    if check_file(path, weights).state == "present":
        log.info(f"{path}: already there")
        return
    if weights.by_hand:
        raise DpcError(
            f"{weights.name}: its publisher has no direct link; download {weights.file} from {weights.url} "
            f"by hand and put it at {path}"
        )
    make_folder(path.parent, "--weights")
    with whole_file(path) as part:
        _download(weights, part)
        log.info(f"{path}: {_check_download(weights, part).finding}")


def _download(weights: Weights, part: Path) -> None:
    try:
        with urlopen(Request(weights.url, headers=_AGENT), timeout=_TIMEOUT) as answer, part.open("wb") as file:
            expected = int(answer.headers.get("Content-Length") or 0)
            received = _copy(answer, file, weights, expected)
    except (URLError, http.client.HTTPException, OSError) as error:
        raise DpcError(_explain_failure(weights, error, part)) from None
    if expected and received != expected:
        raise DpcError(f"{weights.url}: only {received} of {expected} bytes came; try again")


def _copy(answer: http.client.HTTPResponse, file, weights: Weights, expected: int) -> int:
    received = 0
    with Progress(f"fetch {weights.name}", expected // 1000 or None, unit="kB") as bar:
        while block := answer.read(_BLOCK):
            file.write(block)
            received += len(block)
            bar.advance(received // 1000 - bar.done)
    return received


def _explain_failure(weights: Weights, error: Exception, part: Path) -> str:
    if isinstance(error, HTTPError):
        reason = f"the server says {error.code} {error.reason}"
    elif isinstance(error, URLError | http.client.HTTPException | TimeoutError | ConnectionError):
        reason = f"no connection ({getattr(error, 'reason', None) or error})"
    else:
        reason = f"can't write {part} ({error.strerror or error})"
    return (
        f"{weights.url}: {reason}; on a machine with no network, download it elsewhere, put it in a folder as "
        f"{weights.file}, and give the folder with --weights"
    )


def _check_download(weights: Weights, part: Path) -> Checked:
    """Returns what came, if it is the published file; a host that asks to log in or to confirm answers with a page."""
    with part.open("rb") as file:
        page = file.read(100).lstrip()[:1] == b"<"
    if page:
        raise DataError(f"{weights.url}: a web page came instead of {weights.file}; download it by hand")
    found = check_file(part, weights)
    if found.state != "present":
        raise DataError(f"{weights.url}: not the published file ({found.finding}); nothing was kept")
    return found
