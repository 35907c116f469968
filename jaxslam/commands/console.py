"""Where commands print: long lines are left to the terminal to wrap, so that paths can be copied.

No text is read as markup of rich, in tables neither: names of runs, files and settings may hold brackets.
"""

from rich.console import Console

console = Console(soft_wrap=True, markup=False)
plain_console = Console(soft_wrap=True, markup=False, highlight=False)
"""For texts in which numbers should not be colored."""
