"""Reads docs/extending.md: the steps, commands and checks of each path, and applies the steps to a copy."""

import re
import textwrap
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
NUMBERED = re.compile(r"^\d+\. ", re.M)
STEP = re.compile(r"^\d+\. (?P<place>[^\n]*):\n\n(?P<block> +```\w+\n.*?^ +```)$", re.M | re.S)
FILE = re.compile(r"(?:New file|In) `(?P<file>[^`]+)`(?:, (?P<how>.*))?")
LINE = re.compile(r"(?P<how>after|before|replace) the line `(?P<start>.*)`(?:, add| with)")
BLOCK = re.compile(r"^```(?P<language>sh|python)\n(?P<code>.*?)^```$", re.M | re.S)


@dataclass(frozen=True)
class Step:
    """One numbered step: a file, the place in it (None for a new file) and the lines."""

    file: str
    how: str | None
    code: str

    def apply(self, folder: Path) -> None:
        path = folder / self.file
        if self.how is None:
            assert not path.exists(), f"{self.file} is not new"
            path.write_text(self.code, encoding="utf-8")
            return
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        if self.how == "at the end, add":
            first = last = len(lines)
        else:
            first, last = self._place(lines)
        lines[first:last] = [self.code]
        path.write_text("".join(lines), encoding="utf-8")

    def _place(self, lines: list[str]) -> tuple[int, int]:
        """The slice of `lines` that the code replaces."""
        place = LINE.fullmatch(self.how or "")
        assert place, f"cannot be followed: {self.how}"
        found = [index for index, line in enumerate(lines) if line.strip().startswith(place["start"])]
        assert len(found) == 1, f"{self.file} has {len(found)} lines {place['start']}"
        return found[0] + (place["how"] == "after"), found[0] + (place["how"] != "before")


@dataclass(frozen=True)
class ExtensionPath:
    """One path of the page."""

    title: str
    steps: list[Step]
    commands: list[str]
    checks: list[str]  # Python, each with what its prints should show


def paths() -> dict[int, ExtensionPath]:
    """The paths of the page by number."""
    _, *sections = re.split(r"^## (?=\d)", PAGE, flags=re.M)
    return {int(section[0]): read(section) for section in sections}


def read(section: str) -> ExtensionPath:
    title, body = section.split("\n", 1)
    steps = [step_of(found) for found in STEP.finditer(body)]
    assert len(steps) == len(NUMBERED.findall(body)), f"{title}: a step has no file or no code"
    blocks = [(found["language"], found["code"]) for found in BLOCK.finditer(body)]
    commands = [line for language, code in blocks if language == "sh" for line in code.splitlines()]
    return ExtensionPath(title, steps, commands, [code for language, code in blocks if language == "python"])


def step_of(found: re.Match[str]) -> Step:
    place = FILE.fullmatch(found["place"])
    assert place, f"cannot be followed: {found['place']}"
    _, *code, _ = textwrap.dedent(found["block"]).splitlines(keepends=True)
    return Step(place["file"], place["how"], "".join(code))


def printed(check: str) -> list[str]:
    """The lines that a check should print: the comments behind its prints."""
    return re.findall(r"^ *print\(.*\)  # (.*)$", check, re.M)
