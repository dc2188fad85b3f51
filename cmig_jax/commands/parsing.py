"""Flags of a command."""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Callable, Sequence
from typing import Any

import tyro

from cmig_jax.config import FlagError


def parse_flags(kind: Any, prog: str, arguments: Sequence[str], **options: Any) -> Any:
    """Parse the command line as `tyro.cli` does, except that values which a config refuses are an error of one line, like all others.

    Raises:
        FlagError: such a value.
        SystemExit: after `--help`, or after an explanation of what cannot be parsed.
    """
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            return tyro.cli(kind, prog=prog, args=arguments, **options)
    except SystemExit as exit:
        cause: BaseException | None = exit
        while cause is not None:  # tyro raises SystemExit while it handles the config's error
            if isinstance(cause, FlagError):
                raise cause from None
            cause = cause.__context__
        sys.stderr.write(printed.getvalue())
        raise


def parser_of(kind: Any) -> Callable[[Sequence[str], str, Any], Any]:
    """Return the `parse` of a command that needs neither presets nor experiments."""
    return lambda arguments, prog, catalogue: parse_flags(kind, prog, arguments)
