"""How a process ended that failed, in words for an error."""


def how_it_ended(returncode: int) -> str:
    """Return the words for an exit status other than 0; a negative one is that of a signal."""
    return f"killed by signal {-returncode}" if returncode < 0 else f"ended with {returncode}"


def last_words(stderr: str) -> str:
    """Return the last line that a process wrote to its standard error."""
    return (stderr.strip().splitlines() or ["nothing was said"])[-1]
