"""Read the command line that the shell completes from the variables that typer's scripts set."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping

ASKED = "_TACPIPE_COMPLETE"  # Set by the shell: complete_bash, complete_zsh, complete_fish or source_...


def words(environment: Mapping[str, str] = os.environ) -> list[str] | None:
    """Return the words after ``tacpipe`` of the line that the shell completes; None where it completes nothing.

    The word at the cursor is the last one, unless the line ends in a space.

    >>> words({"_TACPIPE_COMPLETE": "complete_bash", "COMP_WORDS": "tacpipe train fo"})
    ['train', 'fo']
    >>> words({"_TACPIPE_COMPLETE": "complete_zsh", "_TYPER_COMPLETE_ARGS": "tacpipe store "})
    ['store']
    """
    if ASKED not in environment:
        return None
    line = environment.get("COMP_WORDS") or environment.get("_TYPER_COMPLETE_ARGS", "")
    try:
        line_words = shlex.split(line)
    except ValueError:  # The line has an open quotation mark.
        line_words = line.split()
    return line_words[1:]
