"""A page in headless Chromium: what it became and, asked for, its picture; keys pressed in it."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium found; apt-get install chromium brings one")
_FLAGS = (
    "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update"
    " --disable-sync --hide-scrollbars --dump-dom"
).split()
# seconds, try by try; a page takes 2 to 5; on a busy machine a browser may hang while it starts
_PATIENCE = (30, 60, 80)


def open_page(address: str, folder: Path, *flags: str) -> tuple[str, str]:
    """The page's final HTML and the browser's stderr. A browser that hangs is killed and another one asked."""
    for attempt, seconds in enumerate(_PATIENCE):
        command = [BROWSER, *_FLAGS, f"--user-data-dir={folder / f'profile{attempt}'}", *flags, address]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        try:
            return process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # its helpers too: they would keep the pipes open
            said = process.communicate()[1]
    pytest.fail(f"{len(_PATIENCE)} browsers hung for {_PATIENCE} s on {address}: {said[-1000:]}")


@contextmanager
def held_page() -> Iterator[tuple[str, str]]:
    """HTML that keeps a page from being loaded, and so the browser waiting in real time, and JavaScript that lets it go on.

    A browser with a made-up time (`--virtual-time-budget`) is over it before its other threads have decoded a video.
    """
    done = threading.Event()

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path == "/done":
                done.set()
            else:
                done.wait(40)
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_words: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Answer) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}"
        try:
            yield f'<img src="{address}/hold">', f'new Image().src = "{address}/done";'
        finally:
            done.set()
            server.shutdown()


# JavaScript for a page's end: `pressed(where, key)` focuses an element and presses a key there, and returns whether the page
# took the key, so that the element itself doesn't get it.
PRESSED = """
const pressed = (where, key) => {
  const at = document.querySelector(where);
  at.focus();
  return !at.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
};
"""
