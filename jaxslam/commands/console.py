"""Where commands print: long lines are left to the terminal to wrap, so that paths can be copied."""

from rich.console import Console

console = Console(soft_wrap=True)
plain_console = Console(soft_wrap=True, markup=False, highlight=False)
"""For texts from elsewhere, which may hold brackets."""
