"""Rows of words in text files, plain or compressed by gzip, with the numbers of their lines."""

import gzip
import os
import zlib
from pathlib import Path
from typing import TypeAlias

from jaxslam.errors import JaxSlamError, one_line

PathLike: TypeAlias = str | os.PathLike[str]


def text_rows(path: PathLike, error: type[JaxSlamError], *, commas: bool = False) -> list[tuple[int, list[str]]]:
    """Read the number and the words of every line that is neither empty nor a comment.

    Args:
        path: Path of the file; one whose name ends in `.gz` is decompressed.
        error: Class of the error to raise.
        commas: Whether words are separated by commas instead of spaces.

    Raises:
        JaxSlamError: An `error`, if the file cannot be read.
    """
    split = (lambda line: [word.strip() for word in line.split(",")]) if commas else str.split
    rows = ((number, split(line)) for number, line in enumerate(read_text(path, error).split("\n"), 1))
    return [(number, words) for number, words in rows if any(words) and not words[0].startswith("#")]


def read_text(path: PathLike, error: type[JaxSlamError]) -> str:
    """Read a text file in UTF-8, decompressed if its name ends in `.gz`.

    Raises:
        JaxSlamError: An `error`, if the file cannot be read.
    """
    try:
        content = Path(path).read_bytes()
        plain = gzip.decompress(content) if Path(path).suffix == ".gz" else content
        return plain.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as problem:
        raise error(f"{path}: cannot be read: {one_line(problem)}") from problem
