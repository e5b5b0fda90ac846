"""Asking the person at the desk to do something, and to say so."""

from __future__ import annotations

import sys

from rich.console import Console


def confirm_at_desk(request: str) -> bool:
    """Ask on stderr, and wait for the answer.

    Parameters
    ----------
    request : str
        What to do, as a sentence.

    Returns
    -------
    bool
        Whether it was done; no where nobody is at the desk (stdin is no terminal).
    """
    console = Console(stderr=True, highlight=False, markup=False)
    if not sys.stdin.isatty():
        console.print(f"{request} Nobody is at the desk to do so.")
        return False
    console.print(f"{request} Press Enter when it is done, or type no.", end=" ")
    answer = sys.stdin.readline()
    # No line at all is the end of the input.
    return bool(answer) and not answer.strip().lower().startswith("n")
