"""The commands on the pages: each is one that the command line takes, and none but a maintainer's leaves the folder."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from holod_training.cli import _parser

FOLDER = Path(__file__).parents[1]
README = (FOLDER / "README.md").read_text()
MAINTAINERS = "## For maintainers"
START = ["python", "-m", "holod_training"]
OWN_FOLDERS = ("data/", "runs/")


def commands(page: str) -> list[list[str]]:
    """The arguments of each command line of the trainer in the page's blocks."""
    blocks = page.split("```")[1::2]
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    split = [shlex.split(line) for line in lines if line.startswith(" ".join(START))]
    return [words[len(START) :] for words in split]


@pytest.mark.parametrize("page", ["README.md", "variants.md"])
def test_every_command_of_the_pages_is_one(page: str) -> None:
    found = commands((FOLDER / page).read_text())
    assert found
    for arguments in found:
        _parser().parse_args(arguments)
    with pytest.raises(SystemExit):
        _parser().parse_args([*found[-1], "--no-such-option"])


def escaping(page: str) -> list[str]:
    """What commands of the page write elsewhere than below `data/` and `runs/`."""
    outs = [vars(_parser().parse_args(arguments)).get("out") for arguments in commands(page)]
    return [out for out in outs if out and not out.startswith(OWN_FOLDERS)]


def test_a_newcomers_commands_write_into_folders_of_ones_own() -> None:
    before, heading, after = README.partition(MAINTAINERS)
    maintainers, _, rest = after.partition("\n## ")
    assert heading and escaping(before + rest) == []
    assert escaping(maintainers) == ["../weights/standard.safetensors", "../doc/eyebox", "../golden"]
    assert README.count("```sh\ncd ") == 1 and "\ncd " not in README.partition("```sh\ncd ")[2]
