#!/usr/bin/env python3
"""Follows every relative link of Markdown pages: tests/links.py PAGE...

Says which lead to no file, or to no heading of a page, and exits with 1 where there are any.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from urllib.parse import unquote

CODE = re.compile(r"^(```|~~~).*?^\1|`[^`\n]*`", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s]+)(?:\s+\"[^\"]*\")?\)")
HEADING = re.compile(r"^#+\s+(.+?)\s*#*$", re.MULTILINE)


def anchors(text: str) -> set[str]:
    """What links to the headings of a page end with."""
    without_fences = re.sub(r"^(```|~~~).*?^\1", "", text, flags=re.MULTILINE | re.DOTALL)
    plain = (re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading) for heading in HEADING.findall(without_fences))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in plain}


def dead(page: Path) -> list[str]:
    """The links of a page that lead to nothing, with why."""
    text = page.read_text(encoding="utf-8")
    found = []
    for link in LINK.findall(CODE.sub(lambda code: re.sub(r"[^\n]", " ", code[0]), text)):
        if re.match(r"[a-z][a-z0-9+.-]*:", link):
            continue
        path, _, part = unquote(link).partition("#")
        target = page.parent / path if path else page
        if not target.exists():
            found.append(f"{page}: {link}: there is no such file")
        elif part and target.suffix == ".md" and part not in anchors(target.read_text(encoding="utf-8")):
            found.append(f"{page}: {link}: there is no such heading")
    return found


def main() -> int:
    pages = [Path(name) for name in sys.argv[1:]]
    if not pages:
        print(__doc__, file=sys.stderr)
        return 64
    found = [fault for page in pages for fault in dead(page)]
    print("\n".join(found) if found else f"every link of {len(pages)} pages leads somewhere")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
