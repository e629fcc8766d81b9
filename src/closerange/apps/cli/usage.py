"""Wrong usage, told in the same words and the same JSON as any other error."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any, cast

import typer
from typer.core import TyperGroup

from closerange.apps.cli.console import INTERRUPTED, tell_error
from closerange.apps.cli.examples import EXAMPLES, line
from closerange.errors import InputError

UsageError = cast(type[Exception], typer.BadParameter.__bases__[0])
"""What the parser raises. Newer versions of typer bring a click of their own: only its child has
a public name in all of them."""


class Verbs(TyperGroup):
    """The group of all verbs."""

    def main(self, args: Sequence[str] | None = None, *more: Any, **extra: Any) -> Any:
        """Run a command line and leave the process with its exit code."""
        given = list(sys.argv[1:] if args is None else args)
        options = given[: given.index("--")] if "--" in given else given
        extra["standalone_mode"] = False  # errors come here instead of being printed
        try:
            code = super().main(given, *more, **extra)
        except UsageError as error:
            told = InputError(_message(error, given), remedy=_remedy(given))
            code = tell_error(told, as_json="--json" in options)
        except (KeyboardInterrupt, typer.Abort):  # before the verb began to work
            code = INTERRUPTED
        sys.exit(code if isinstance(code, int) else 0)


def _remedy(given: list[str]) -> str:
    """Show the example of the verb that was meant, and point to its help."""
    verb = next((name for name in (" ".join(given[:2]), *given[:1]) if name in EXAMPLES), "")
    if verb:
        return f"for instance {line(verb)}\ncloserange {verb} --help explains every option"
    near = get_close_matches(given[0], EXAMPLES, n=1) if given else []
    question = f"did you mean {near[0]!r}? " if near else ""
    return f"{question}closerange --help lists the verbs"


def _message(error: Any, given: list[str]) -> str:
    """Write the parser's sentence as ours: small at the beginning, with the value, no full stop."""
    text = " ".join(str(error.format_message()).split()).partition(" Did you mean ")[0]
    text = text[:1].lower() + text[1:].removesuffix(".")
    value = _value(getattr(error, "param", None), given)
    return f"{text} (given: {value})" if value and repr(value) not in text else text


def _value(parameter: Any, given: list[str]) -> str:
    """Return what was given for an option; blank if nothing was, or it is an argument."""
    for option in getattr(parameter, "opts", ()):
        if option in given:
            at = given.index(option) + 1
            return " ".join(given[at : at + parameter.nargs])
    return ""
