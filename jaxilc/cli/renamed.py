"""Options that have another name since this version: they are taken, with a warning."""

from __future__ import annotations

from typing import Any

import typer.core

from .console import err

BEFORE = ("--figures", "--precision")  # now stand before the name of the command
# For each command what replaces an option; `{}` is its value, and without it the option is a flag.
OF_ALL = {"--json": "--report {}"}
CAMPAIGN = (
    *("limit", "largest-correction", "saturation", "repeatability", "growth"),
    *("reference", "number"),
)
RENAMED: dict[str, dict[str, str]] = {
    "next": {
        "--plant-file": "--scenario {}",
        **{f"--{n}": f"--set campaign.{n.replace('-', '_')}={{}}" for n in CAMPAIGN},
        **{
            f"--{name}": f"--set campaign.{name.replace('-', '_')}=true"
            for name in ("accept-saturation", "stop-on-growth", "replayed-input", "short-trial")
        },
        "--predict": "--set campaign.predict=true",
        "--no-predict": "--set campaign.predict=false",
    },
}


class Commands(typer.core.TyperGroup):
    """The commands, which also take the names that options had until now."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, now_named(args, [*self.commands]))


def now_named(words: list[str], commands: list[str]) -> list[str]:
    """The words of a command line with options as they are called now.

    words: words after the name of the program
    commands: names of all commands
    """
    at = next((i for i, word in enumerate(words) if word in commands), len(words))
    known = OF_ALL | RENAMED.get(words[at], {}) if words[at:] else {}
    before, after, rest = words[:at], words[at : at + 1], words[at + 1 :]
    while rest:
        word, *rest = rest
        name, equals, value = word.partition("=")
        if name not in (*known, *BEFORE):
            after.append(word)
            continue
        now = known.get(name, f"{name} {{}}")
        if "{}" in now and not equals and rest:
            value, *rest = rest
        said = f"{now.format(value)} ... {words[at]}" if name in BEFORE else now.format(value)
        err.print(f"warning: {name} is now {said}", highlight=False, soft_wrap=True)
        option, of = now.split(" ")
        (before if name in BEFORE else after).extend((option, of.format(value)))
    return before + after
