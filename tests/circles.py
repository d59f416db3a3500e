#!/usr/bin/env python3
"""Finds files of a crate that use one another in a circle: tests/circles.py SRC...

Each SRC is the folder of a crate's sources. That a file uses those in the folder below it, as a `mod.rs` does, is no
part of a circle, and neither is what tests use. Says which circles there are, and exits with 1 where there are any.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

# A module by the names on the way to it from the crate's root; and a path of names in it.
Module = tuple[str, ...]
Names = tuple[str, ...]
Edges = dict[Module, dict[Module, str]]

NOT_CODE = re.compile(
    r"/\*.*?\*/|//[^\n]*"
    r"|\bb?r(?P<hashes>#*)\".*?\"(?P=hashes)"
    r"|b?\"(?:\\.|[^\"\\])*\""
    r"|b?'(?:\\[^']+|\\'|[^'\\])'",
    re.DOTALL,
)
TESTS = "#[cfg(test)]\nmod tests {"
USE = re.compile(r"(?:^|\n)\s*(pub(?:\([^)]*\))?\s+)?use\s+([^;]+);")
PATH = re.compile(r"(?<![\w:.])(\w+(?:::\w+)+)")


def code(path: Path) -> str:
    """What of a file is code, without the tests at its end."""
    text = path.read_text(encoding="utf-8")
    text = text[: text.find(TESTS)] if TESTS in text else text
    # A comment may hold a quotation mark and a text two slashes: whichever begins first is the one.
    return NOT_CODE.sub(lambda found: " " if found[0].startswith("/") else '""', text)


def branches(tree: str) -> Iterator[Names]:
    """The paths of a `use` with braces."""
    before, brace, rest = tree.partition("{")
    names = tuple(re.sub(r"\s+as\s+\w+", "", name).strip() for name in before.split("::") if name.strip())
    if not brace:
        yield names
        return
    depth, branch = 0, ""
    for letter in rest.rstrip()[:-1] + ",":
        depth += (letter == "{") - (letter == "}")
        if letter == "," and depth == 0:
            if branch.strip():
                yield from (names + inner for inner in branches(branch.strip()))
            branch = ""
        else:
            branch += letter


class Crate:
    """The modules of a crate, one to a file, and what each brings in from others."""

    def __init__(self, source: Path) -> None:
        """Reads all files of `source`, but the programs in `bin` and folders of tests."""
        self.files: dict[Module, Path] = {}
        for path in sorted(source.rglob("*.rs")):
            parts = path.relative_to(source).with_suffix("").parts
            if "tests" in parts or parts[0] == "bin":
                continue
            last = () if parts[-1] in ("mod", "lib", "main") else parts[-1:]
            self.files[parts[:-1] + last] = path
        self.uses: dict[Module, list[tuple[Names, bool]]] = {}
        self.brought: dict[Names, Names] = {}
        for module, path in self.files.items():
            self.read(module, code(path))

    def read(self, module: Module, text: str) -> None:
        """Takes note of the paths in a file: whole ones, and whether they only hand on a name of another file."""
        uses = self.uses.setdefault(module, [])
        for public, tree in USE.findall(text):
            for names in branches(tree.strip()):
                if (whole := self.whole(names, module)) is not None:
                    uses.append((whole, bool(public)))
                    if public:
                        self.brought[(*module, names[-1])] = whole
        for path in PATH.findall(USE.sub("\n", text)):
            if (whole := self.whole(tuple(path.split("::")), module)) is not None:
                uses.append((whole, False))

    def whole(self, names: Names, module: Module) -> Names | None:
        """A path from the crate's root; none where it leads out of the crate or to the file's own names."""
        if names[0] == "crate":
            return names[1:]
        if names[0] == "self":
            return module + names[1:]
        if names[0] == "super":
            up = next((index for index, name in enumerate(names) if name != "super"), len(names))
            return module[: len(module) - up] + names[up:]
        return module + names if (*module, names[0]) in self.files else None

    def target(self, path: Names, steps: int = 10) -> Module:
        """The module that a path leads into, by way of those that hand its name on."""
        length = next(length for length in range(len(path), -1, -1) if path[:length] in self.files)
        onward = self.brought.get(path[: length + 1]) if length < len(path) else None
        if onward is None or onward == path or steps == 0:
            return path[:length]
        return self.target(onward + path[length + 1 :], steps - 1)

    def edges(self) -> Edges:
        """Which file uses which other one, and by which path; those that lie below it are left out."""
        edges: Edges = {module: {} for module in self.files}
        for module, uses in self.uses.items():
            for path, hands_on in uses:
                target = self.target(path)
                if not hands_on and target[: len(module)] != module:
                    edges[module].setdefault(target, "::".join(path))
        return edges


def circle(edges: Edges) -> list[Module] | None:
    """The shortest way from a file by others back to itself, if there is any."""
    shortest: list[Module] | None = None
    for start in edges:
        ways, known = [[start]], {start}
        for way in ways:
            if shortest is not None and len(way) >= len(shortest):
                break
            if start in edges[way[-1]]:
                shortest = way
                break
            onward = [target for target in edges[way[-1]] if target not in known]
            known.update(onward)
            ways.extend([*way, target] for target in onward)
    return shortest


def circles(source: Path) -> list[str]:
    """The circles of a crate, one after the other, each without the last use of those before it."""
    crate = Crate(source)
    edges, found = crate.edges(), []
    while (way := circle(edges)) is not None:
        steps = list(zip(way, way[1:] + way[:1], strict=True))
        told = [f"    {crate.files[one]} uses {crate.files[other]} by {edges[one][other]}" for one, other in steps]
        found.append("\n".join([f"{source}: files that use one another in a circle", *told]))
        one, other = steps[-1]
        del edges[one][other]
    return found


if __name__ == "__main__":
    for given in sys.argv[1:]:
        if not any(Path(given).rglob("*.rs")):
            sys.exit(f"{given}: found no Rust source there, expected the folder of a crate's sources")
    all_circles = [line for source in sys.argv[1:] for line in circles(Path(source))]
    print("\n".join(all_circles) or "no circles")
    sys.exit(1 if all_circles else 0)
