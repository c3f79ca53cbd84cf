"""Names of a file that a report must not take as markup."""

from __future__ import annotations

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"
NAMES = ["wave", f"b {EVIL}", "50% & #1_{x}"]
